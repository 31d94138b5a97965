"""Files made to deceive: each trick by itself, and what it would cost."""

import json
import os
import resource
import threading
import zipfile
from pathlib import Path

import h5py
import numpy as np
import pytest
from campaign.forks import child
from hostile_files import ARCHIVE, EXCHANGE, OURS, RESULT, RESULT_ATTRIBUTES, image, npy

from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.io import load_scan


def exchange(path, tricks=None, **others):
    path.write_bytes(image(EXCHANGE | OURS | others, {("polysplat/geometry", "astra_type"): "cone_vec",
                                                     ("polysplat/geometry", "unit"): "mm"}, tricks or {}))  # fmt: skip
    return path


def archive(path, method=zipfile.ZIP_DEFLATED, **members):
    contents = {name: npy(array) for name, array in ARCHIVE.items()} | members
    with zipfile.ZipFile(path, "w") as file:
        for name, content in contents.items():
            file.writestr(f"{name}.npy", content, method)
    return path


def test_a_long_list_of_members_is_not_taken_into_memory(tmp_path):
    """One of 10^6 names, which a file of 100 MB may hold, takes a gigabyte before anything is asked."""
    path = archive(tmp_path / "scan.npz")
    assert load_scan(path).projections.size
    with zipfile.ZipFile(path, "a") as file:
        for number in range(20_000):
            file.writestr(f"{number}.npy", b"")
    with pytest.raises(ValueError, match="list of members has .* bytes"):
        load_scan(path)


def test_the_files_that_are_tampered_with_are_sound_before(tmp_path):
    for make in (exchange, archive):
        scan = load_scan(make(tmp_path / "scan"))
        assert scan.projections.shape == (2, 3, 4) and scan.truth is not None and scan.spectrum is not None


@pytest.mark.parametrize("path", ["exchange/data", "exchange", "polysplat/truth", "polysplat/geometry"])
@pytest.mark.parametrize(
    ("trick", "message"),
    [("external", "beside it"), ("circle", "links"), ("type", "a dataset of numbers|a group|no such")],
)
def test_links_that_lead_nowhere(tmp_path, path, trick, message):
    file = exchange(tmp_path / "scan.h5", {path: trick})
    with pytest.raises(ValueError, match=message):
        load_scan(file)


@pytest.mark.parametrize(
    "trick", ["virtual", "outside", "huge", "huge chunk", "ragged", "opaque", "empty", "group"]
)
def test_datasets_that_hold_no_numbers(tmp_path, trick):
    file = exchange(tmp_path / "scan.h5", {"exchange/data": trick})
    with pytest.raises(ValueError, match="expected (data in|a dataset of numbers|as much data|at most)"):
        load_scan(file)


@pytest.mark.parametrize("kind", [h5py.vlen_dtype(np.dtype("f4")), h5py.ref_dtype, np.dtype([("a", "f4")])])
def test_attributes_that_are_no_numbers_or_texts(tmp_path, kind):
    """Of a damaged one h5py reads what is not there, and the process ends."""
    path = exchange(tmp_path / "scan.h5")
    with h5py.File(path, "a") as file:
        attributes = file["polysplat/geometry"].attrs
        del attributes["astra_type"]
        h5py.h5a.create(
            file["polysplat/geometry"].id, b"astra_type", h5py.h5t.py_create(kind, logical=True),
            h5py.h5s.create(h5py.h5s.SCALAR),
        )  # fmt: skip
    with pytest.raises(ValueError, match="astra_type.*a number or a text"):
        load_scan(path)


def test_soft_links_within_the_file_are_followed(tmp_path):
    file = exchange(tmp_path / "scan.h5")
    with h5py.File(file, "r+") as handle:
        handle.move("exchange/data", "elsewhere")
        handle["exchange/data"], handle["alias"] = h5py.SoftLink("/alias"), h5py.SoftLink("elsewhere")
    assert load_scan(file).projections.shape == (2, 3, 4)


def test_another_file_is_not_even_opened(tmp_path):
    """A named pipe hangs whoever opens it."""
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    file = exchange(tmp_path / "scan.h5")
    with h5py.File(file, "r+") as handle:
        del handle["exchange/data_dark"]
        handle["exchange/data_dark"] = h5py.ExternalLink(str(pipe), "/data")
    answer = []

    def read():
        with pytest.raises(ValueError, match="put pipe"):
            load_scan(file)
        answer.append(True)

    thread = threading.Thread(target=read, daemon=True)
    thread.start()
    thread.join(20)
    assert answer == [True]


def test_a_heap_that_would_hold_hdf5_for_ever(tmp_path):
    """Free space of no length: HDF5 goes round in it, deaf to Ctrl-C."""
    file = exchange(tmp_path / "scan.h5")
    content = bytearray(file.read_bytes())
    place = content.index(b"GCOL\x01\x00\x00\x00")
    content[place + 16 : place + 32] = bytes(16)
    file.write_bytes(content)
    with pytest.raises(ValueError, match="damaged heap"):
        load_scan(file)


@pytest.mark.parametrize("method", [zipfile.ZIP_LZMA, zipfile.ZIP_BZIP2])
def test_compressions_that_numpy_never_writes(tmp_path, method):
    with pytest.raises(ValueError, match="stored or deflated"):
        load_scan(archive(tmp_path / "scan.npz", method))


def test_pickles_are_not_loaded(tmp_path):
    class Trap:
        def __reduce__(self):
            return os.mkdir, (str(tmp_path / "sprung"),)

    content = npy(np.array([Trap()], object))
    with pytest.raises(ValueError, match="never loaded"):
        load_scan(archive(tmp_path / "scan.npz", vectors=content))
    assert not (tmp_path / "sprung").exists()


HEADER = "{'descr': '<f4', 'fortran_order': False, 'shape': (10, 10000, 10000)}"


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_a_header_of_gigabytes_takes_no_memory(tmp_path):
    file = archive(tmp_path / "scan.npz", projections=npy(np.zeros(10**6), HEADER))

    def refuse():
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with pytest.raises(ValueError, match="as its header declares"):
            load_scan(file)
        assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50 * 1024

    # What a child has taken is told from what earlier tests took.
    assert child(refuse) == 0


def test_what_files_say_is_no_html(tmp_path):
    evil = "<script>alert(1)</script>"
    parts = RESULT | {
        "polysplat/plan": json.dumps(
            {evil: {"value": {evil: [evil]}, "why": evil, "status": "found", "evidence": {evil: 1}}}
        ),
        "polysplat/counts": f'{{"{evil}": 5}}',
        "polysplat/settings": f'{{"name": "{evil}"}}',
    }
    file, page = tmp_path / "result.h5", tmp_path / "page.html"
    file.write_bytes(image(parts, RESULT_ATTRIBUTES, {}))
    Result.load(file).report(page)
    text = page.read_text(encoding="utf-8")
    assert "&lt;script&gt;alert" in text and "<script>alert" not in text


def test_a_unit_that_is_none_is_refused(tmp_path):
    file = tmp_path / "result.h5"
    file.write_bytes(image(RESULT, RESULT_ATTRIBUTES | {("polysplat", "unit"): "<b>$\\frac"}, {}))
    with pytest.raises(ValueError, match="unit in the file"):
        Result.load(Path(file))

"""HDF5 as beamlines store it: filters, chunks, virtual datasets, links; each against h5py's own reading."""

import json
import os

import h5py
import numpy as np
import pytest

from tomo_polysplat.scan.hdf5 import find_array, opened, read_attribute, read_json, read_text, text_attribute
from tomo_polysplat.scan.io import load_scan

SHAPE = (7, 5, 9)
RANDOM = np.random.default_rng(4)
COUNTS = RANDOM.integers(0, 4000, SHAPE).astype(np.uint16)
LINES = RANDOM.normal(size=SHAPE).astype(np.float32)
KEYS = [
    (),
    slice(2, 5),
    slice(None, None, 3),
    (slice(1, 6, 2), slice(0, 4), slice(3, None, 4)),
    3,
    (slice(None), 2),
    Ellipsis,
    slice(4, 4),
]


def same(path, name="exchange/data"):
    """Every part is what h5py reads."""
    with h5py.File(path) as plain, opened(path) as file:
        found = find_array(file, name)
        for key in KEYS:
            np.testing.assert_array_equal(found[key], plain[name][key], err_msg=str(key))
            assert found[key].dtype == plain[name].dtype


FILTERS = {
    "none": {},
    "deflate": {"compression": "gzip"},
    "shuffle": {"compression": "gzip", "shuffle": True},
    "check sum": {"fletcher32": True},
    "all": {"compression": "gzip", "compression_opts": 9, "shuffle": True, "fletcher32": True},
}


@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize("filters", FILTERS)
def test_chunks_are_read_as_h5py_reads_them(tmp_path, filters, libver):
    path = tmp_path / "a.h5"
    datas = (COUNTS, LINES, LINES.astype(">f8"), COUNTS > 2000, LINES.astype("f2"))
    for data, chunks in zip(datas, ((2, 3, 4), SHAPE, (1, 5, 9), (3, 1, 1), (7, 5, 2))):
        with h5py.File(path, "w", libver=libver) as file:
            file.create_dataset("exchange/data", data=data, chunks=chunks, **FILTERS[filters])
        same(path)


def test_chunks_that_were_never_written_hold_the_fill_value(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        data = file.create_dataset(
            "exchange/data", SHAPE, "f4", chunks=(2, 5, 9), compression="gzip", fillvalue=7
        )
        data[2:4] = LINES[2:4]
    same(tmp_path / "a.h5")


@pytest.mark.parametrize("filters", [{"compression": "lzf"}, {"scaleoffset": 0}, {"compression": "szip"}])
def test_other_filters_are_undone_in_a_process_of_their_own(tmp_path, filters):
    if filters.get("compression") == "szip" and not h5py.h5z.filter_avail(h5py.h5z.FILTER_SZIP):
        pytest.skip("this HDF5 has no szip")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("exchange/data", data=COUNTS, chunks=(4, 3, 9), **filters)
    with opened(tmp_path / "a.h5") as file:
        np.testing.assert_array_equal(find_array(file, "exchange/data")[1:6:2], COUNTS[1:6:2])


def test_filters_of_hdf5plugin_are_undone_where_it_is_installed(tmp_path):
    plugin = pytest.importorskip("hdf5plugin")
    with h5py.File(tmp_path / "a.h5", "w") as file:
        for name, compression in (
            ("lz4", plugin.Bitshuffle()),
            ("blosc", plugin.Blosc()),
            ("zstd", plugin.Zstd()),
        ):
            file.create_dataset(name, data=COUNTS, chunks=(4, 5, 9), **compression)
    with opened(tmp_path / "a.h5") as file:
        for name in ("lz4", "blosc", "zstd"):
            np.testing.assert_array_equal(find_array(file, name)[()], COUNTS)


def test_a_filter_that_nobody_has_is_named_with_its_remedy(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_chunk(SHAPE)
        plist.set_filter(299, h5py.h5z.FLAG_OPTIONAL, (1,))
        space = h5py.h5s.create_simple(SHAPE)
        data = h5py.h5d.create(file.id, b"data", h5py.h5t.NATIVE_UINT16, space, plist)
        data.write_direct_chunk((0, 0, 0), COUNTS.tobytes(), 0)
    with opened(tmp_path / "a.h5") as file, pytest.raises(ValueError, match="/data: .*unpacked.*hdf5"):
        find_array(file, "data")[()]


# Parts that an array may be made of ------------------------------------------------------------------------------


def frames(folder, number, name="data"):
    with h5py.File(folder / f"frames{number}.h5", "w") as file:
        file[name] = LINES[number] if name == "frame" else LINES[number : number + 2]


def virtual(path, parts):
    layout = h5py.VirtualLayout(SHAPE, "f4", filename=str(path))
    for key, source in parts:
        layout[key] = source
    with h5py.File(path, "w", libver="latest") as file:
        file.create_virtual_dataset("exchange/data", layout, fillvalue=-1)
        file["exchange/own"] = LINES


@pytest.mark.parametrize("kind", ["pairs", "frames", "strided", "own", "crop", "nested"])
def test_virtual_datasets_of_files_beside_this_one(tmp_path, kind, monkeypatch):
    monkeypatch.chdir(tmp_path)  # h5py looks from there
    (tmp_path / "raw").mkdir()
    path = tmp_path / "scan.h5"
    if kind in ("pairs", "nested"):
        for first in (0, 2, 4):
            frames(tmp_path / "raw", first)
        parts = [
            (slice(first, first + 2), h5py.VirtualSource(f"raw/frames{first}.h5", "data", (2, *SHAPE[1:])))
            for first in (0, 2, 4)
        ]
    elif kind == "frames":
        for view in range(7):
            frames(tmp_path / "raw", view, "frame")
        parts = [(view, h5py.VirtualSource(f"raw/frames{view}.h5", "frame", SHAPE[1:])) for view in range(7)]
    elif kind == "strided":
        with h5py.File(tmp_path / "even.h5", "w") as file:
            file["data"] = LINES[::2]
        parts = [(slice(0, 7, 2), h5py.VirtualSource("even.h5", "data", (4, *SHAPE[1:])))]
    else:
        source = h5py.VirtualSource(".", "exchange/own", SHAPE)
        parts = [(slice(None), source)]
        if kind == "crop":
            parts = [((slice(0, 3), slice(1, 4), slice(2, 9)), source[1:7:2, 2:5, 0:7])]
    virtual(path, parts)
    if kind == "nested":
        virtual(tmp_path / "outer.h5", [(slice(None), h5py.VirtualSource("scan.h5", "exchange/data", SHAPE))])
        path = tmp_path / "outer.h5"
    same(path)


def test_files_elsewhere_are_refused_and_the_remedy_works(tmp_path):
    other, folder = tmp_path / "elsewhere", tmp_path / "here"
    other.mkdir(), folder.mkdir()
    with h5py.File(other / "raw.h5", "w") as file:
        file["data"] = LINES
    with h5py.File(folder / "scan.h5", "w") as file:
        file["linked"] = h5py.ExternalLink(str(other / "raw.h5"), "/data")
        layout = h5py.VirtualLayout(SHAPE, "f4")
        layout[:] = h5py.VirtualSource(str(other / "raw.h5"), "data", SHAPE)
        file.create_virtual_dataset("virtual", layout)
    (folder / "raw.h5").symlink_to(other / "raw.h5")
    for name in ("linked", "virtual"):
        with (
            opened(folder / "scan.h5") as file,
            pytest.raises(ValueError, match=r"put raw.h5 .* into .*here"),
        ):
            find_array(file, name)[()]
    (folder / "raw.h5").unlink()
    (other / "raw.h5").rename(folder / "raw.h5")
    for name in ("linked", "virtual"):
        with opened(folder / "scan.h5") as file:
            np.testing.assert_array_equal(find_array(file, name)[()], LINES)


def test_a_link_to_a_file_beside_this_one_is_followed(tmp_path):
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file["entry/data"], file["up"] = LINES, h5py.SoftLink("/entry")
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        file["exchange"] = h5py.ExternalLink("raw.h5", "/up")
        file["loop"] = h5py.ExternalLink("scan.h5", "/loop")
    same(tmp_path / "scan.h5")
    with opened(tmp_path / "scan.h5") as file, pytest.raises(ValueError, match="at most 16 links"):
        find_array(file, "loop")


def test_virtual_datasets_of_themselves_end(tmp_path):
    path = tmp_path / "a.h5"
    virtual(path, [(slice(None), h5py.VirtualSource(".", "exchange/data", SHAPE))])
    with opened(path) as file, pytest.raises(ValueError, match="one in another"):
        find_array(file, "exchange/data")[()]


# Texts -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("libver", ["earliest", "latest"])
@pytest.mark.parametrize("text", ["", "mm", "Größe µ", "x" * 5000])
def test_texts_of_any_kind_of_storage(tmp_path, text, libver):
    path = tmp_path / "a.h5"
    kind, names = h5py.string_dtype(), ["plain", "fixed", "compact"]
    with h5py.File(path, "w", libver=libver) as file:
        file["plain"], file["fixed"] = text, np.array(text.encode() or b"\0")
        if text != "mm":  # unpacked by a process of its own, for which short texts are alike
            packing = {"chunks": (1,), "compression": "gzip", "shuffle": True}
            names.append(file.create_dataset("packed", data=[text], dtype=kind, **packing).name)
        plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plist.set_layout(h5py.h5d.COMPACT)
        space = h5py.h5s.create(h5py.h5s.SCALAR)
        compact = h5py.h5d.create(file.id, b"compact", h5py.h5t.py_create(kind, logical=True), space, plist)
        h5py.Dataset(compact)[()] = text
        many = file.create_group("many", track_order=True)
        for group in (file.create_group("few"), many):
            group.attrs["text"] = text
            group.attrs["list"] = [text]
        for number in range(20):
            many.attrs[f"n{number}"] = "another"
    with opened(path) as file:
        for name in names:
            assert read_text(file, name) == text, name
        for group in ("few", "many"):
            assert text_attribute(file[group], "text") == text
            assert text_attribute(file[group], "list") == text


def test_a_text_of_megabytes(tmp_path):
    content = {str(number): "x" * 100 for number in range(20_000)}
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["json"] = json.dumps(content)
        file["after"] = "short"
    with opened(tmp_path / "a.h5") as file:
        assert read_json(file, "json", {}) == content and read_text(file, "after") == "short"


def test_a_hundred_gigabytes_are_not_looked_through_for_texts(tmp_path):
    """A sparse file: only what is asked for is read."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        data = file.create_dataset("exchange/data", (200, 2048, 2048), "f4")
        data[0, 0, 0] = 1
        file["name"] = "a sample"
        file.attrs["unit"] = "mm"
    assert path.stat().st_size > 3e9 > 1000 * path.stat().st_blocks
    with opened(path) as file:
        assert read_text(file, "name") == "a sample" and read_attribute(file, "unit") == "mm"


def test_a_scan_out_of_several_files(tmp_path):
    """As ESRF and Diamond write: views in files of their own under bitshuffle or gzip, and a master file."""
    with h5py.File(tmp_path / "raw.h5", "w") as file:
        file.create_dataset("data", data=np.abs(LINES), chunks=(1, 5, 9), compression="gzip", shuffle=True)
    layout = h5py.VirtualLayout(SHAPE, "f4")
    layout[:] = h5py.VirtualSource("raw.h5", "data", SHAPE)
    with h5py.File(tmp_path / "scan.h5", "w", libver="latest") as file:
        file.create_virtual_dataset("exchange/data", layout)
        file["exchange/theta"] = np.arange(7) * 26.0
    scan = load_scan(tmp_path / "scan.h5", input="attenuation", centre=4.5)
    np.testing.assert_array_equal(scan.projections, np.abs(LINES).transpose(1, 0, 2))
    os.remove(tmp_path / "raw.h5")
    with pytest.raises(ValueError, match="/exchange/data: expected .*beside it, got a link to raw.h5"):
        load_scan(tmp_path / "scan.h5", input="attenuation", centre=4.5)

"""Small HDF5 files that ask for gigabytes, for ever, or for the end of the process: all refused in one process."""

import resource
import struct
import time
import zlib

import h5py
import numpy as np
import pytest
from campaign.forks import child
from hostile_files import EXCHANGE, OURS, RESULT, RESULT_ATTRIBUTES, image

from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.hdf5 import opened, read_text
from tomo_polysplat.scan.hdf5_heaps import heap_object
from tomo_polysplat.scan.io import load_scan

GEOMETRY = {("polysplat/geometry", "astra_type"): "cone_vec", ("polysplat/geometry", "unit"): "mm"}
MEGABYTES = 600
SHAPE = (3, 2, 4)


def deflated(megabytes=MEGABYTES):
    """Zeros in zlib's format: one megabyte packed by itself, many times over."""
    block, check = bytes(2**20), 1
    packer, nothing = (zlib.compressobj(9, zlib.DEFLATED, -zlib.MAX_WBITS) for _ in range(2))
    piece = packer.compress(block) + packer.flush(zlib.Z_FULL_FLUSH)
    for _ in range(megabytes):
        check = zlib.adler32(block, check)
    return b"\x78\xda" + megabytes * piece + nothing.flush() + check.to_bytes(4, "big")


BOMB = deflated()


def replaced(file, name, chunk, **filters):
    """A dataset of one chunk, whose bytes are given as they are stored."""
    shape, dtype = file[name].shape, file[name].dtype
    del file[name]
    made = file.create_dataset(name, shape, dtype, chunks=shape, **filters)
    made.id.write_direct_chunk((0,) * len(shape), chunk)


def packed_zeros(file, name):
    dtype = file[name].dtype
    del file[name]
    made = file.create_dataset(name, (2**24 * 5,), dtype, chunks=(2**24,), compression="gzip")
    chunk = zlib.compress(bytes(2**24 * dtype.itemsize), 1)
    for first in range(0, len(made), 2**24):
        made.id.write_direct_chunk((first,), chunk)


def check_sum_of_packed(file, name):
    """Check sum first, deflate second: what deflate gives is too short for the sum."""
    shape = file[name].shape
    del file[name]
    plist = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plist.set_chunk(shape)
    plist.set_fletcher32()
    plist.set_deflate(1)
    made = h5py.h5d.create(
        file.id, name.encode(), h5py.h5t.NATIVE_UINT16, h5py.h5s.create_simple(shape), plist
    )
    made.write_direct_chunk((0,) * len(shape), zlib.compress(b"\1\2"), 0)


def links(file, name):
    file.move(name, "x")
    file["s0"] = h5py.SoftLink("/")
    for depth in range(1, 13):
        file[f"s{depth}"] = h5py.SoftLink("/" + "/".join([f"s{depth - 1}"] * 10))
    file[name] = h5py.SoftLink("/s12/x")


def long_path(file, name):
    file.move(name, "x")
    file["s"] = h5py.SoftLink("/" + "./" * 20000 + "x")
    file[name] = h5py.SoftLink("/".join(["/exchange/.."] * 3000))


TRICKS = {
    "deflate behind a true shape": lambda file: replaced(file, "exchange/data", BOMB, compression="gzip"),
    "the same in a mask": lambda file: replaced(file, "polysplat/valid", BOMB, compression="gzip"),
    "the same under shuffle": lambda file: replaced(
        file, "exchange/data_white", BOMB, compression="gzip", shuffle=True
    ),
    "three numbers of 640 MB": lambda file: packed_zeros(file, "polysplat/geometry/volume_shape"),
    "energies": lambda file: packed_zeros(file, "polysplat/spectrum/energies"),
    "vectors": lambda file: packed_zeros(file, "polysplat/geometry/vectors"),
    "truth": lambda file: packed_zeros(file, "polysplat/truth"),
    "open-beam images": lambda file: packed_zeros(file, "exchange/data_white"),
    "check sum of 2 bytes": lambda file: replaced(file, "exchange/data", b"\1\2", fletcher32=True),
    "check sum in a packed chunk": lambda file: check_sum_of_packed(file, "exchange/data"),
    "lzf of nothing": lambda file: replaced(file, "exchange/data", b"\1", compression="lzf"),
    "scale and offset": lambda file: replaced(file, "exchange/data", b"\xff" * 5, scaleoffset=0),
    "plain chunk too short": lambda file: replaced(file, "exchange/data", b"\1"),
    "plain chunk too long": lambda file: replaced(file, "exchange/data", bytes(2**20)),
    "soft links by number": lambda file: links(file, "exchange/data"),
    "a long path": lambda file: long_path(file, "exchange/data"),
}


def read_each(paths, told):
    """Read the files one after the other; of each a line into the file ``told``."""
    load_scan(paths[0])
    with told.open("w") as file:
        for path in paths[1:]:
            begun, before = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
            try:
                (Result.load if "result" in path.name else load_scan)(path)
                line = "ACCEPTED"
            except (ValueError, MemoryError) as error:
                taken = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
                cheap = taken < 2e5 and time.process_time() - begun < 4
                line = ("ok" if cheap else f"COSTS {taken}") + f" {str(error)[:150]!r}"
            file.write(line + "\n")


def results(folder):
    """Results of which the stored length of one text, in a dataset or in an attribute, says 2 GB."""
    content = image(RESULT, RESULT_ATTRIBUTES, {})
    (folder / "result.h5").write_bytes(content)
    with h5py.File(folder / "result.h5") as file:
        place = file["polysplat/plan"].id.get_offset()
    reference = content.index(struct.pack("<I", 2) + content[place + 4 : place + 12])
    for number, at in enumerate((place, reference)):
        broken = bytearray(content)
        broken[at : at + 4] = struct.pack("<I", 2**31 - 1)
        path = folder / f"result{number}.h5"
        path.write_bytes(broken)
        yield path


@pytest.mark.filterwarnings("ignore:.*fork:DeprecationWarning")
def test_each_is_refused_at_no_cost(tmp_path):
    sound = image(EXCHANGE | OURS, GEOMETRY, {})
    (tmp_path / "sound").write_bytes(sound)
    paths = [tmp_path / "sound"]
    for name, trick in TRICKS.items():
        paths.append(tmp_path / name)
        paths[-1].write_bytes(sound)
        with h5py.File(paths[-1], "r+") as file:
            try:
                trick(file)
            except OSError as refused:
                # Old releases of HDF5 write no chunk that is longer than its shape.
                assert "chunk size can't be encoded" in str(refused)
                paths.pop()
                continue
        assert paths[-1].stat().st_size < 5e6
    assert len(paths) > len(TRICKS) - 4
    paths += results(tmp_path)
    # What a child has taken is told from what earlier tests took, and it may be ended.
    assert child(lambda: read_each(paths, tmp_path / "told")) == 0
    lines = (tmp_path / "told").read_text().splitlines()
    assert len(lines) == len(paths) - 1
    # Not every index of chunks stores how long a plain one is: then other bytes of the file may be read, at no cost.
    # Old releases of HDF5 do not look whether a chunk of scaled numbers is whole.
    unchecked = (
        ("plain chunk", "scale and offset") if h5py.version.hdf5_version_tuple < (1, 14) else "plain chunk"
    )
    bad = [
        f"{path.name}: {line}"
        for path, line in zip(paths[1:], lines)
        if not (line.startswith("ok") or (line.startswith("ACCEPTED") and path.name.startswith(unchecked)))
    ]
    assert not bad, "\n".join(bad)


def heap(tmp_path, *objects, size=None):
    """A file of nothing but one heap at byte 64; objects are (index, length, bytes)."""
    body = b"".join(
        struct.pack("<HHIQ", index, 1, 0, length) + content.ljust(-(-len(content) // 8) * 8, b"\0")
        for index, length, content in objects
    )
    path = tmp_path / "heap"
    size = 16 + len(body) if size is None else size
    path.write_bytes(bytes(64) + b"GCOL\1\0\0\0" + struct.pack("<Q", size) + body)
    return open(path, "rb")


def test_objects_of_a_heap(tmp_path):
    with heap(tmp_path, (1, 5, b"hallo"), (7, 3, b"abc"), (0, 16, b"")) as stream:
        assert heap_object(stream, "x", 64, 7) == b"abc"
        assert heap_object(stream, "x", 64, 1, 2) == b"ha"
        for index, length in ((2, 1), (0, 1), (1, 6)):
            with pytest.raises(ValueError, match="of a heap"):
                heap_object(stream, "x", 64, index, length)
        for place in (0, 63, 10**6, 2**63 - 1):
            with pytest.raises(ValueError, match="damaged heap"):
                heap_object(stream, "x", place, 1)


@pytest.mark.parametrize(
    ("objects", "size"),
    [
        ([(0, 0, b"")], None),
        ([(1, 5, b"hallo"), (0, 8, b"")], None),
        ([(1, 2**63, b"hallo")], None),
        ([(1, 5, b"hallo")], 2**40),
        ([(1, 0, b"")] * 70_000, None),
    ],
)
def test_heaps_that_would_hold_hdf5_for_ever(tmp_path, objects, size):
    with heap(tmp_path, *objects, size=size) as stream, pytest.raises(ValueError, match="damaged heap"):
        heap_object(stream, "x", 64, 1)


def test_a_virtual_dataset_with_a_damaged_heap_is_not_opened(tmp_path):
    path = tmp_path / "scan.h5"
    layout = h5py.VirtualLayout(SHAPE, "f4")
    layout[:] = h5py.VirtualSource(".", "own", SHAPE)
    with h5py.File(path, "w", libver="latest") as file:
        file["own"] = np.ones(SHAPE, "f4")
        file.create_virtual_dataset("exchange/data", layout)
    content = bytearray(path.read_bytes())
    place = content.index(b"GCOL\1\0\0\0")
    content[place + 16 : place + 32] = bytes(16)
    path.write_bytes(content)
    with pytest.raises(ValueError, match="/exchange/data: .*damaged heap"):
        load_scan(path)


def test_texts_within_a_heap_are_read_though_another_heap_is_damaged(tmp_path):
    """Only what is asked for is looked at."""
    path = tmp_path / "a.h5"
    with h5py.File(path, "w") as file:
        file["first"] = "x" * 3000
        file["second"] = "y" * 3000
    content = bytearray(path.read_bytes())
    place = content.rindex(b"GCOL\1\0\0\0")
    assert place != content.index(b"GCOL\1\0\0\0")
    content[place + 16 : place + 32] = bytes(16)
    path.write_bytes(content)
    with opened(path) as file:
        assert read_text(file, "first") == "x" * 3000
        with pytest.raises(ValueError, match="/second: .*damaged heap"):
            read_text(file, "second")

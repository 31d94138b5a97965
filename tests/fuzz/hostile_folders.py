"""Scanners' folders, tables of text and checkpoints that somebody has tampered with."""

import re
import tempfile
from functools import cache
from pathlib import Path

import h5py
import numpy as np
from hostile_files import ODD, hdf5_files
from hostile_values import damaged
from hypothesis import strategies as st

from tomo_polysplat.simulate.folders.nikon import ASIDE
from tomo_polysplat.simulate.folders.scene import marked_scan
from tomo_polysplat.simulate.folders.write import write_folder

VIEWS, ROWS, COLUMNS = 4, 6, 7
TEXTS = (".toml", ".xml", ".log", ".txt", ".xtekct", ".csv", ".mha")
# What stands in the place of a file.
PIPE, FOLDER, CIRCLE = "a named pipe", "a folder", "a link to itself"
NUMBERS = re.compile(rb"[-+]?\d+(?:\.\d*)?(?:[eE][-+]?\d+)?")
ODD_NUMBERS = [
    *(b"", b"nan", b"-inf", b"-1", b"0", b"-0.0", b"1e999", b"1e308", b"1e-320", b"9" * 400, b"9" * 5000),
    *(b"0x10", b"1,5", b"1:2", b"one", b"[1, 2]", b"2147483648", b"1e12", b"true", b"\xd9\xa3", b"1 2 3"),
]
ODD_LINES = [
    *(b"\x1b[31mred\x1b[0m", b"\x00", b"=", b"[", b"[" * 4000, b"a = " + b"[" * 4000, b"x" * 100_000),
    *(
        b"<a>" * 4000,
        b'<!DOCTYPE a [<!ENTITY b "b">]>',
        b"{",
        b"}",
        b"\xff\xfe",
        b"\xef\xbb\xbf",
        b"a.b.c.d = 1",
    ),
    *(
        b"projections = '../*'",
        b"degrees = '/dev/zero'",
        b"flats = '/etc'",
        b"unit = 'inch'",
        b"[Acquisition]",
    ),
    *(b"Number Of Files = 1000000000", b"Dim_1 = 100000 ;", b"DimSize = 100000 100000 100000", b"NDims = 9"),
    *(b"ElementDataFile = LIST", b"ElementDataFile = /dev/zero", b"ElementNumberOfChannels = 1000000000"),
    *(b"CompressedData = True", b"CompressedDataSize = 9000000000000", b"HeaderSize = -1", b"Size = 0 ;"),
]
WORDS = [0, 1, 2, 3, 7, 0x7F, 0xFF, 0x7FFF, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**64 - 1]


@cache
def sound(kind) -> dict[str, bytes]:
    """The files of a whole folder of a kind, by their names."""
    aside = {"columns_off": 0.0, "aside": ASIDE} if kind == "nikon" else {}
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "scan"
        write_folder(kind, folder, marked_scan(VIEWS, ROWS, COLUMNS, **aside))
        files = {path.name: path.read_bytes() for path in sorted(folder.iterdir())}
    if kind == "tiffs":
        angles = "".join(f"{90 * view}.5\n" for view in range(VIEWS))
        files["angles.txt"] = angles.encode()
        files["scan.toml"] = files["scan.toml"].replace(b"arc = 360", b'degrees = "angles.txt"')
    return files


@st.composite
def changed_text(draw, content: bytes) -> bytes:
    """Other numbers in it, or lines that are gone, twice there, elsewhere, or odd."""
    if draw(st.booleans()):
        spans = [match.span() for match in NUMBERS.finditer(content[:20_000])]
        for begin, end in sorted(
            draw(st.lists(st.sampled_from(spans), min_size=1, max_size=3)), reverse=True
        ):
            content = content[:begin] + draw(st.sampled_from(ODD_NUMBERS)) + content[end:]
        return content
    lines = content.split(b"\n")
    place, other = (draw(st.integers(0, len(lines) - 1)) for _ in range(2))
    odd = draw(st.sampled_from(ODD_LINES))
    what = draw(st.sampled_from(["gone", "twice", "elsewhere", "odd", "odd", "in it"]))
    if what == "gone":
        del lines[place]
    elif what == "elsewhere":
        lines.insert(other, lines.pop(place))
    elif what == "in it":
        lines[place] += odd
    else:
        lines.insert(other, lines[place] if what == "twice" else odd)
    return b"\n".join(lines)


@st.composite
def changed_words(draw, content: bytes) -> bytes:
    """A few numbers of 1 to 8 bytes at their ends of what such numbers may be, more often in what is a header."""
    changed = bytearray(content)
    ends = st.one_of(st.integers(0, 300), st.integers(max(len(content) - 300, 0), len(content)))
    for at in draw(st.lists(ends | st.integers(0, len(content)), min_size=1, max_size=4)):
        size, order = draw(st.sampled_from([1, 2, 4, 8])), draw(st.sampled_from(["little", "big"]))
        at -= at % min(size, 2)
        changed[at : at + size] = (draw(st.sampled_from(WORDS)) % 256**size).to_bytes(size, order)
    return bytes(changed[: len(content)])


def tampered(name, content):
    """Contents of a file, or what stands in its place."""
    text = st.just(name.endswith(TEXTS)).flatmap(
        lambda text: changed_text(content) if text else changed_words(content)
    )
    kinds = [damaged(content), text, text, text, changed_words(content)]
    rare = st.sampled_from([b"", PIPE, FOLDER, CIRCLE, None])
    return st.integers(0, 19).flatmap(lambda number: rare if number == 19 else kinds[number % len(kinds)])


@st.composite
def folders(draw, kind, only=None) -> dict[str, bytes | str]:
    """A folder of a kind with one or two of its files tampered with, all the same or not."""
    files = dict(sound(kind))
    names = [name for name in files if only is None or name in only]
    # Logs and the like tell more than one picture of many does.
    named = st.sampled_from([name for name in names if name.endswith(TEXTS)] or names) | st.sampled_from(
        names
    )
    for name in draw(st.lists(named, min_size=1, max_size=2, unique=True)):
        if not isinstance(files[name], bytes):
            continue
        content = draw(tampered(name, files[name]))
        files[name] = content
        if draw(st.integers(0, 9)) == 0:
            files = {
                other: content if Path(other).suffix == Path(name).suffix else files[other] for other in files
            }
    return {name: content for name, content in files.items() if content is not None}


def put(files, folder: Path) -> None:
    """Make the folder with these files."""
    folder.mkdir()
    for name, content in files.items():
        path = folder / name
        if content == PIPE:
            import os

            os.mkfifo(path)
        elif content == FOLDER:
            path.mkdir()
        elif content == CIRCLE:
            path.symlink_to(name)
        else:
            path.write_bytes(content)


def taken_apart(kind):
    """Datasets and attributes of the HDF5 file of a kind of folder, by their paths."""
    (content,) = sound(kind).values()
    datasets, attributes = {}, {}
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "file"
        path.write_bytes(content)
        with h5py.File(path) as file:

            def take(name, item):
                attributes.update({(name, key): value for key, value in item.attrs.items()})
                if isinstance(item, h5py.Dataset):
                    datasets[name] = (
                        item[()].decode() if item.shape == () and item.dtype == object else item[()]
                    )

            file.visititems(take)
    return datasets, attributes


def neXus(kind):  # noqa: N802  # so it is written
    """The HDF5 file of such a folder, made anew with other parts."""
    return st.deferred(lambda: hdf5_files(*taken_apart(kind), ODD))


TABLE = "".join(f"{20 + 5 * k}.0 {k * (16 - k)}.5e-2\n" for k in range(16))
TABLES = [
    ("# keV\tweight\n" + TABLE).encode("utf-8-sig"),
    TABLE.replace(" ", ";").replace(".", ",").encode("utf-16"),
    ("Energy,Fluence\r\n" + TABLE.replace(" ", ",")).encode("latin-1"),
]
SPECTRUM_TABLES = st.sampled_from(TABLES).flatmap(
    lambda table: changed_text(table) | damaged(table) | changed_words(table)
)


def _npy(array) -> bytes:
    import io

    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


def _tiff(array) -> bytes:
    import io

    import tifffile

    buffer = io.BytesIO()
    tifffile.imwrite(buffer, array)
    return buffer.getvalue()


THICKNESS = np.linspace(0.1, 0.5, ROWS * COLUMNS, dtype=np.float32).reshape(ROWS, COLUMNS)
THICKNESSES = {
    "map.npy": _npy(THICKNESS),
    "map.tif": _tiff(THICKNESS),
    "map.csv": "\n".join(",".join(f"{value:.3f}" for value in row) for row in THICKNESS).encode(),
}
FILTER_MAPS = st.sampled_from(sorted(THICKNESSES)).flatmap(
    lambda name: st.tuples(st.just(name), tampered(name, THICKNESSES[name]))
)

"""Compound files of Zeiss' and stacks in NumPy archives that somebody has tampered with."""

import io
from functools import cache

import numpy as np
from hostile_files import npz_files
from hostile_folders import COLUMNS, ROWS, VIEWS, changed_words, folders, sound
from hostile_values import damaged, mostly
from hypothesis import strategies as st

from tomo_polysplat.simulate.folders.compound_file import compound_file
from tomo_polysplat.simulate.folders.scene import marked_scan, pictures_of
from tomo_polysplat.simulate.folders.xradia import streams_of

# Of the tables of a compound file's sectors and of its directory, which lie at its end.
TABLES = 9000
SECTORS = [*range(12), 0x7FFFFFFF, 0xFFFFFFFA, 0xFFFFFFFB, 0xFFFFFFFC, 0xFFFFFFFD, 0xFFFFFFFE, 0xFFFFFFFF]
NUMBERS = [np.array(n, "<i4").tobytes() for n in (0, 1, -1, 2, 3, 5, 7, 10, 11, 12, 65535, 65536, 2**31 - 1)]
NUMBERS += [np.array(x, "<f4").tobytes() for x in (np.nan, np.inf, -np.inf, 1e38, -1e38, 1e-42, -2.5, 90)]
TEXTS = [b"", b"\0", b"x", b"\x1b[31mred", b"Al 1e999mm", b"Al -1mm\0", b"LE3\0", b"\xff" * 5000, b"9" * 5000]
BESIDE = b'flats = "open.xrm"\n'


@cache
def streams() -> dict[str, bytes]:
    return streams_of(pictures_of(marked_scan(VIEWS, ROWS, COLUMNS)))


@cache
def open_beam() -> dict[str, bytes]:
    """Of a file with a single picture, which is no scan of its own but may be the open beam of one."""
    one = {name: content for name, content in streams().items() if name.startswith("ImageInfo/")}
    one |= {f"ImageInfo/{name}": np.array(1, "<i4").tobytes() for name in ("NoOfImages", "ImagesTaken")}
    one["ImageInfo/DataType"] = streams()["ReferenceData/DataType"]
    return one | {"ImageData1/Image1": streams()["ReferenceData/Image"]}


@st.composite
def changed_numbers(draw, content: bytes) -> bytes:
    """A stream with one of its numbers at an end of what it may be, cut, repeated, or another."""
    number = draw(st.sampled_from(NUMBERS))
    kind = draw(st.sampled_from(["one", "one", "all", "cut", "twice", "text"]))
    if kind == "one":
        at = 4 * draw(st.integers(0, max(len(content) // 4 - 1, 0)))
        return content[:at] + number + content[at + 4 :]
    if kind == "all":
        return number * max(1, len(content) // 4)
    if kind == "text":
        return draw(st.sampled_from(TEXTS))
    return content * 2 if kind == "twice" else content[: draw(st.integers(0, len(content)))]


@st.composite
def changed_tables(draw, content: bytes) -> bytes:
    """Chains of sectors that lead elsewhere, into a circle or out of the file, and other lengths of streams."""
    changed, first = bytearray(content), max(0, len(content) - TABLES) // 4 * 4
    for at in draw(st.lists(st.integers(0, TABLES // 4 - 1), min_size=1, max_size=6)):
        word = draw(st.sampled_from(SECTORS) | st.integers(0, len(content) // 512))
        changed[first + 4 * at : first + 4 * at + 4] = word.to_bytes(4, "little")
    return bytes(changed[: len(content)])


@st.composite
def compounds(draw, whole: dict[str, bytes]) -> bytes:
    """A file of such streams with others in it, and other tables or bytes."""
    content = dict(whole)
    for name in draw(st.lists(st.sampled_from(sorted(whole)), max_size=2, unique=True)):
        content[name] = draw(mostly(changed_numbers(whole[name]), st.none()))
    made = compound_file({name: value for name, value in content.items() if value is not None})
    kinds = [st.just(made), st.just(made), changed_tables(made), changed_words(made), damaged(made)]
    return draw(st.integers(0, len(kinds) - 1).flatmap(lambda number: kinds[number]))


@st.composite
def xradia_folders(draw) -> dict[str, bytes]:
    """A scan of Zeiss', with its open beam in a file of its own or not."""
    files = {"marker.txrm": draw(mostly(compounds(streams()), st.just(compound_file(streams()))))}
    if draw(st.booleans()):
        files |= {"open.xrm": draw(compounds(open_beam())), "scan.toml": BESIDE}
    return files


@st.composite
def npz_stacks(draw) -> dict[str, bytes]:
    """An archive of pictures with the file that tells the distances beside it."""
    files = dict(sound("npz"))
    (name,) = (name for name in files if name.endswith(".npz"))
    with np.load(io.BytesIO(files[name])) as archive:
        arrays = dict(archive)
    return files | {name: draw(npz_files(arrays))}


XRADIA = xradia_folders() | folders("xradia") | folders("xrm")
NPZ_STACKS = st.deferred(lambda: npz_stacks() | folders("npz"))

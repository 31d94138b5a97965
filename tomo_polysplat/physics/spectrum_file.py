"""Read a spectrum from a table of text, as spectrometers, spreadsheets and simulators write it."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import file_content

__all__ = ["read_spectrum_table"]

# A table of a million energies has less.
_LARGEST = 64 * 2**20
_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
# What begins a line that holds no numbers; text before the first line of numbers is a header.
_REMARKS = ("#", "%", "//", ";", "!")
_COMMA_IN_NUMBER = re.compile(r"(?<=\d),(?=\d)")


def read_spectrum_table(path: str | Path, argument: str = "path") -> tuple[np.ndarray, np.ndarray]:
    """(n,) energies in keV and (n,) weights: two numbers a line, between them blanks, a tab, a comma or a semicolon.

    Lines above the first number may be a header; remarks begin with ``#``, ``%``, ``//``, ``;`` or ``!``. With a
    semicolon or a tab between the columns a decimal comma is read too. UTF-8 and UTF-16 are read, with a byte order
    mark or without.

    Raises
    ------
    FileNotFoundError, OSError
        If there is no such file.
    ValueError
        For a line that is no two numbers, by its number, or a file without any.
    """
    file, content = Path(path), file_content(path, _LARGEST, argument)
    rows: list[tuple[float, float]] = []
    for number, line in enumerate(_text(content, file, argument).splitlines(), start=1):
        words = line.strip()
        if not words or words.startswith(_REMARKS):
            continue
        row = _two_numbers(words)
        if row is not None:
            rows.append(row)
        elif rows or _begins_with_number(words):
            remedy = "keep two columns: energy in keV and weight"
            raise fail(argument, "two numbers a line", f"{words[:60]!r} in line {number} of {file}", remedy)
    if not rows:
        raise fail(argument, "lines of two numbers, keV and weight", f"none in {file}")
    energies, weights = np.array(rows).T
    return energies, weights


def _text(content: bytes, file: Path, argument: str) -> str:
    encoding = next((name for mark, name in _MARKS if content.startswith(mark)), "utf-8")
    if encoding == "utf-8" and b"\0" in content[:400]:
        # UTF-16 of Latin characters: every other byte is 0.
        encoding = "utf-16-be" if content[:1] == b"\0" else "utf-16-le"
    try:
        return content.decode(encoding)
    except UnicodeDecodeError as error:
        if encoding == "utf-8":
            # Headers in the code page of an older program; the numbers are the same in all of them.
            return content.decode("latin-1")
        remedy = "save it as text in UTF-8"
        raise fail(argument, f"text in {encoding}", f"{file} ({error.reason})", remedy) from error


def _two_numbers(line: str) -> tuple[float, float] | None:
    """The numbers of a line; None if it is something else."""
    line = re.split(r"[#%!]|//", line, maxsplit=1)[0].strip()
    for between in (";", "\t"):
        if between in line:
            words = [_COMMA_IN_NUMBER.sub(".", word) for word in line.split(between)]
            break
    else:
        words = line.replace(",", " ").split()
    words = [word.strip().strip('"') for word in words if word.strip()]
    if len(words) != 2:
        return None
    try:
        return float(words[0]), float(words[1])
    except ValueError:
        return None


def _begins_with_number(line: str) -> bool:
    """Whether this is a broken row rather than a header."""
    return re.match(r'"?[-+]?\.?\d+(?:[.,]\d+)?\s*(?:[,;\s]|$)', line) is not None

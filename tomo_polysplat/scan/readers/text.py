"""Texts as scanners' programs write them: of any encoding, and with the decimal sign of the country."""

from __future__ import annotations

import codecs
import re
from pathlib import Path

from tomo_polysplat.files import file_content

__all__ = ["NUMBER", "number_of", "text_of"]

# A number with either decimal sign. No scanner's program groups thousands.
NUMBER = r"[-+]?(?:\d+(?:[.,]\d*)?|[.,]\d+)(?:[eE][-+]?\d+)?"
_MARKS = ((codecs.BOM_UTF8, "utf-8"), (codecs.BOM_UTF16_LE, "utf-16-le"), (codecs.BOM_UTF16_BE, "utf-16-be"))


def text_of(source: Path | bytes, most: int, argument: str = "path") -> str:
    """The text of a file, or of bytes: UTF-8 or UTF-16, else the Western one of Windows.

    Parameters
    ----------
    source : Path or bytes
    most : int
        Bytes that the file may have.
    """
    content = source if isinstance(source, bytes) else file_content(source, most, argument)
    for mark, name in _MARKS:
        if content.startswith(mark):
            return content[len(mark) :].decode(name, "replace")
    if content[1:2] == b"\0":
        return content.decode("utf-16-le", "replace")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        return content.decode("cp1252", "replace")


def number_of(text: str) -> str | None:
    """The number that a text begins with, with a decimal point; None where it begins with none."""
    match = re.match(rf"\s*({NUMBER})(?![.,]?\d)", text)
    return None if match is None else match[1].replace(",", ".")

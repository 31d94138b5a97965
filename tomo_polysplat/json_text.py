"""JSON from files that may be damaged or hostile."""

from __future__ import annotations

import json
import math
import re
from itertools import accumulate
from typing import Any

from tomo_polysplat.checks import fail

__all__ = ["parse_json"]

# What the longest runs write is a thousandth of this: a history of a dozen numbers a pass.
_MOST_VALUES, _DEEPEST, _LONGEST = 1_000_000, 50, 1 << 26
_LONGEST_NUMBER = 40
# The end of a string may be missing: asked for, it would be looked for from every quotation mark in it.
_STRINGS = re.compile(r'"(?:[^"\\]|\\.)*"?', re.DOTALL)
_BRACKETS = re.compile(r"[\[{\]}]")


def parse_json(text: str, where: str, *, finite: bool = True) -> Any:
    """What a text says, of so many values and so deep as an honest file may have.

    Both are counted before anything is made of them: an empty object is two characters of text, but a hundred
    bytes of memory.

    Parameters
    ----------
    text : str
    where : str
        What it was read from, for the error.
    finite : bool
        Refuse NaN and infinity, also as numbers that are too large.

    Raises
    ------
    ValueError
        If it is not JSON, or too much of it.
    """
    if len(text) > _LONGEST or text.count(",") + text.count("[") + text.count("{") > _MOST_VALUES:
        raise fail(where, f"JSON of at most {_MOST_VALUES} values", f"more in {len(text)} characters")
    if (depth := _depth(text)) > _DEEPEST:
        raise fail(where, f"JSON nested at most {_DEEPEST} deep", f"{depth}")

    def number(digits: str) -> Any:
        if len(digits) > _LONGEST_NUMBER:
            raise ValueError(f"a number of {len(digits)} digits")
        value = float(digits) if set(digits) & set(".eEnN") else int(digits)
        if finite and not math.isfinite(value):
            raise ValueError(f"the number {digits}")
        return value

    try:
        return json.loads(text, parse_int=number, parse_float=number, parse_constant=number)
    except (ValueError, RecursionError) as error:
        raise fail(where, "JSON text", f"{text[:40]!r} ({str(error)[:80]})") from error


def _depth(text: str) -> int:
    brackets = _BRACKETS.findall(_STRINGS.sub("", text))
    return max(accumulate(1 if bracket in "[{" else -1 for bracket in brackets), default=0)

"""Checks of what a caller hands over.

Every failure names the argument, says what was expected and what was got, and how to mend it.
"""

from __future__ import annotations

import difflib
import math
import unicodedata
from collections.abc import Iterable
from typing import Any

import numpy as np

__all__ = [
    *("did_you_mean", "fail", "require_array", "require_choice", "require_number", "require_shape"),
    "visible",
]

# Characters. A whole file may be handed over as a name, and comparing that would take long.
_LONGEST_NAME = 60
# Unicode's categories of what has no shape of its own: control, format (the direction of writing among them),
# halves of surrogate pairs, and the separators of lines and paragraphs.
_UNSEEN = ("Cc", "Cf", "Cs", "Zl", "Zp")


def visible(text: Any) -> str:
    """A text from a file or a caller as it may be shown in a terminal, a log or a page.

    Characters that would move the cursor, change colours or the direction of writing, or hide others, become
    their numbers: an escape becomes ``\\x1b``. Line ends become spaces.

    Parameters
    ----------
    text : anything
        What is no text is shown as `str` shows it.
    """
    whole = str(text)
    if whole.isprintable():
        return whole
    return "".join(map(_visible, whole))


def _visible(character: str) -> str:
    if character in "\n\r\t":
        return " "
    if unicodedata.category(character) not in _UNSEEN:
        return character
    number = ord(character)
    return (
        f"\\x{number:02x}" if number < 256 else f"\\u{number:04x}" if number < 65536 else f"\\U{number:08x}"
    )


def fail(
    argument: str, expected: str, got: Any, remedy: str = "", error: type[Exception] = ValueError
) -> Exception:
    """The exception to raise: ``raise fail("angles", "radians", "degrees", "use numpy.deg2rad")``."""
    message = f"{_short(argument, 200)}: expected {visible(expected)}, got {_short(got, 400)}"
    return error(f"{message}; {visible(remedy)}" if remedy else message)


def _short(text: Any, longest: int) -> str:
    """What a caller passed may be a whole file."""
    whole = str(text)
    return visible(whole if len(whole) <= longest else f"{whole[:longest]} ...")


def require_number(
    argument: str,
    value: Any,
    *,
    above: float = -math.inf,
    at_least: float = -math.inf,
    at_most: float = math.inf,
    remedy: str = "",
) -> float:
    """A finite number within bounds, as a float."""
    try:
        number = float(value)
    except (TypeError, ValueError, OverflowError):
        raise fail(argument, "a number", f"{value!r}", remedy, TypeError) from None
    if not (math.isfinite(number) and number > above and at_least <= number <= at_most):
        bounds = [
            f"> {above:g}" if above > -math.inf else "",
            f">= {at_least:g}" if at_least > -math.inf else "",
            f"<= {at_most:g}" if at_most < math.inf else "",
        ]
        wanted = " and ".join(b for b in bounds if b)
        raise fail(argument, f"a finite number {wanted}".rstrip(), f"{number!r}", remedy)
    return number


def require_choice(argument: str, value: Any, choices: Iterable[str], remedy: str = "") -> str:
    """One of a few names."""
    known = list(choices)
    # An array is no name, and comparing it with one gives an array.
    if not isinstance(value, str) or value not in known:
        meant = did_you_mean(value, known)
        raise fail(
            argument, f"one of {', '.join(known)}", repr(value), "; ".join(filter(None, (meant, remedy)))
        )
    return value


def did_you_mean(value: Any, known: Iterable[str]) -> str:
    """``"did you mean ...?"`` with the names that are close to what was given, or nothing."""
    if not isinstance(value, str) or len(value) > _LONGEST_NAME:
        return ""
    names = {name.lower(): name for name in known}
    close = difflib.get_close_matches(value.lower(), names, n=3, cutoff=0.6)
    return f"did you mean {' or '.join(names[name] for name in close)}?" if close else ""


def require_array(argument: str, value: Any, ndim: int | None = None, remedy: str = "") -> np.ndarray:
    """A numeric array of real numbers (never an object array), of ``ndim`` axes when given."""
    try:
        array = np.asarray(value)
    except (TypeError, ValueError) as error:
        raise fail(argument, "an array of real numbers", str(error), remedy) from None
    if array.dtype.kind not in "fiub":
        raise fail(argument, "an array of real numbers", f"dtype {array.dtype}", remedy, TypeError)
    if ndim is not None and array.ndim != ndim:
        raise fail(argument, f"{ndim} axes", f"shape {array.shape}", remedy)
    return array


def require_shape(argument: str, array: Any, shape: tuple[int, ...], meaning: str, remedy: str = "") -> None:
    """An exact shape; ``meaning`` names its axes, such as ``"(rows, views, columns)"``."""
    if tuple(array.shape) != tuple(shape):
        raise fail(argument, f"shape {tuple(shape)} {meaning}", f"{tuple(array.shape)}", remedy)

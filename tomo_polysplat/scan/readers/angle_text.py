"""Angles of views as people and programs list them."""

from __future__ import annotations

import re

import numpy as np

from tomo_polysplat.checks import fail

__all__ = ["angles_in", "require_degrees"]

# Share of a step by which even angles may miss a half or a whole turn and still be meant to make one.
_TURN = 0.1


def angles_in(text: str) -> np.ndarray:
    """The last number of each line; lines of words at the top, and what follows ``#``, are passed over.

    A comma is the decimal sign where there is no point, and blanks, semicolons or nothing part the columns.

    Raises
    ------
    ValueError
        For a line, below the first with a number, that ends with none.
    """
    lines = [line for line in (line.split("#")[0].strip(" \t°") for line in text.splitlines()) if line]
    decimal = _decimal_commas(lines)
    rows = [line.replace(",", "." if decimal else " ").replace(";", " ").split() for line in lines]
    first = next((k for k, words in enumerate(rows) if _is_number(words[-1])), len(rows))
    return np.array([float(words[-1]) for words in rows[first:]])


def require_degrees(angles: np.ndarray, argument: str = "degrees") -> np.ndarray:
    """Refuse even angles that make a half or a whole turn in radians."""
    if len(angles) > 2 and np.isfinite(angles).all():
        steps = np.diff(angles)
        step = float(np.median(steps))
        for turn in (np.pi, 2 * np.pi):
            # The last view stands at the turn's end or one step before it.
            missed = min(abs(turn - abs(k * step)) for k in (len(angles), len(angles) - 1))
            if np.ptp(steps) < _TURN * abs(step) and missed < _TURN * abs(step):
                got = f"{angles[0]:.3g} to {angles[-1]:.3g}, which look like radians"
                raise fail(argument, "angles in degrees", got, "multiply them by 180 / pi")
    return angles


def _decimal_commas(lines: list[str]) -> bool:
    points = any(re.search(r"\d\.\d", line) for line in lines)
    if points or not any(re.search(r"\d,\d", line) for line in lines):
        return False
    if any(re.search(r"[^;\s][;\s]+[-+]?\d", line) for line in lines):
        return True
    halves = [line.split(",") for line in lines if re.search(r"\d", line)]
    if any(len(parts) != 2 or not parts[0].strip().lstrip("+-").isdecimal() for parts in halves):
        return False
    counted = [int(parts[0]) for parts in halves]
    # Numbers of pictures count on by one; whole degrees before a comma would have to as well, each with a fraction.
    return len(counted) < 2 or any(after - before != 1 for before, after in zip(counted, counted[1:]))


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True

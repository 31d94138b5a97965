"""Angles of views: in radians, and finite."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_array

__all__ = ["require_radians"]


def require_radians(argument: str, angles: Any) -> np.ndarray:
    """Angles (views,) in radians as float64, refused where they look like degrees.

    Raises
    ------
    ValueError, TypeError
        For other than finite numbers along one axis, and for degrees.
    """
    values = require_array(argument, angles, ndim=1).astype(np.float64)
    if not np.isfinite(values).all():
        raise fail(argument, "finite numbers", f"{np.sum(~np.isfinite(values))} NaN or infinite")
    if _look_like_degrees(values):
        raise fail(
            argument,
            "radians",
            f"{values.min():g} to {values.max():g}, which look like degrees",
            "use numpy.deg2rad(angles); if they are radians over many turns, take them modulo 2*pi",
        )
    return values


def _look_like_degrees(angles: np.ndarray) -> bool:
    """More than two turns, and either a round arc in degrees or small steps that make no whole turns."""
    if len(angles) < 2 or np.ptp(angles) <= 4 * np.pi:
        return False
    step = float(np.median(np.abs(np.diff(angles))))
    arcs = np.ptp(angles) + np.array([0.0, step])  # without and with the end point
    round_degrees = np.abs(arcs / 45 - np.round(arcs / 45)) < 1e-4
    whole_turns = np.abs(arcs / (2 * np.pi) - np.round(arcs / (2 * np.pi))) < 0.02
    return bool(round_degrees.any() or (step < 1.5 and not whole_turns.any()))

"""Pins: a PMMA cylinder with water-like texture and two metal pins, the plainest case of metal streaks."""

from __future__ import annotations

from tomo_polysplat.simulate.blocks import domed_cylinder, strew
from tomo_polysplat.simulate.phantom import Part
from tomo_polysplat.simulate.shapes import cylinder, ellipsoid

__all__ = ["HALF_WIDTH", "parts"]

HALF_WIDTH = 2.5


def parts() -> list[Part]:
    """The parts in cm, in order of precedence."""
    texture = cylinder((0, 0, 0), 2.0, 1.4)
    return [
        *domed_cylinder((2.2, 2.2), 1.2, 0.65, "pmma", 1.19),
        *strew(texture, 60, "water", (0.94, 1.06), (0.10, 0.30), seed=1),
        Part(cylinder((0.1, 1.25, 0.1), 0.35, 1.0), "water", 1.0),
        Part(cylinder((-0.2, -1.2, 0.0), 0.30, 1.2, (0.3, 0.1, 1.0)), "adipose", 0.95),
        Part(ellipsoid((0.9, -1.0, 0.6), (0.30, 0.45, 0.25)), "water", 1.1),
        Part(cylinder((-0.95, 0.05, 0.0), 0.08, 0.9), "iron", 7.87, metal=True),
        Part(cylinder((0.95, 0.20, 0.0), 0.09, 0.8, (0.10, 0.05, 1.0)), "iron", 7.87, metal=True),
    ]

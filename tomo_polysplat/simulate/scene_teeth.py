"""Teeth: a lower jaw with enamel, dentine and pulp, in soft tissue, with three metal fillings."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.simulate.blocks import domed_cylinder, strew
from tomo_polysplat.simulate.phantom import Part
from tomo_polysplat.simulate.shapes import box, cylinder, ellipsoid, rotation

__all__ = ["HALF_WIDTH", "parts"]

HALF_WIDTH = 2.5
ENAMEL = "hydroxyapatite"  # at the density of young enamel
FILLED = (1, 4, 8)


def parts() -> list[Part]:
    """The parts in cm, in order of precedence."""
    listed = [
        *domed_cylinder((2.25, 2.05), 1.4, 0.5, "muscle", 1.05),
        Part(cylinder((0, -0.25, 0.55), (1.05, 1.25), 0.9), "water", 1.0),
        Part(ellipsoid((0, -0.45, 0.1), (0.80, 1.15, 0.55)), "muscle", 1.07),
        *strew(
            ellipsoid((0, -0.45, 0.1), (0.75, 1.1, 0.5)), 25, "adipose", (0.93, 0.97), (0.05, 0.14), seed=2
        ),
    ]
    places = _arch(10)
    for x, y, angle in places:
        listed.append(
            Part(ellipsoid((x, y, -1.14), (0.45, 0.42, 0.50), rotation((0, 0, 1), angle)), "bone", 1.55)
        )
    for x, y, angle in places:
        alveolar = ellipsoid((x, y, -1.18), (0.34, 0.30, 0.38), rotation((0, 0, 1), angle))
        listed.append(Part(alveolar, "bone", 1.18))
    for n, (x, y, angle) in enumerate(places):
        listed += _tooth(x, y, angle, molar=n in (0, 1, 2, 7, 8, 9))
    return listed + [_filling(*places[n]) for n in FILLED]


def _arch(count: int) -> list[tuple[float, float, float]]:
    """Places on a parabola open to -y, at equal arc length, with the angle of its tangent in degrees."""
    x = np.linspace(-1.5, 1.5, 2001)
    y = 1.35 - 1.15 * x**2
    along = np.concatenate([[0.0], np.cumsum(np.hypot(np.diff(x), np.diff(y)))])
    at = np.interp(np.linspace(0, along[-1], count), along, x)
    return [(float(p), float(1.35 - 1.15 * p**2), float(np.degrees(np.arctan(-2.3 * p)))) for p in at]


def _tooth(x: float, y: float, angle: float, molar: bool) -> list[Part]:
    """Root and crown of dentine under enamel, round a pulp canal; molars have two roots and cusps."""
    turn = rotation((0, 0, 1), angle)
    wide, deep = (0.27, 0.25) if molar else (0.21, 0.17)
    along = turn @ np.array([0.13, 0.0, 0.0])
    centre = np.array([x, y, -0.42])
    roots = [centre - along, centre + along] if molar else [centre]
    built = [Part(ellipsoid(c + (0, 0, -0.55), (0.11, 0.13, 0.62), turn), "bone", 1.80) for c in roots]
    built.append(Part(ellipsoid(centre + (0, 0, 0.22), (wide, deep, 0.40), turn), ENAMEL, 1.9))
    if molar:
        built += [Part(ellipsoid(c + (0, 0, 0.52), 0.09, turn), ENAMEL, 1.9) for c in roots]
    built.append(Part(ellipsoid(centre + (0, 0, 0.08), (0.84 * wide, 0.82 * deep, 0.36), turn), "bone", 1.80))
    built.append(Part(ellipsoid(centre, (0.07, 0.06, 0.22), turn), "water", 1.03))
    return built + [Part(cylinder(c + (0, 0, -0.45), 0.035, 0.45), "water", 1.03) for c in roots]


def _filling(x: float, y: float, angle: float) -> Part:
    """A small inlay in the top of a crown."""
    return Part(box((x, y, 0.02), (0.16, 0.12, 0.11), rotation((0, 0, 1), angle)), "iron", 7.87, metal=True)

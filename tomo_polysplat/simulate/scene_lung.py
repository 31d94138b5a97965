"""Lung: a thorax with lungs and their vessels, heart, ribs and spine, with screws and rods in the spine.

Scaled to 7 cm, which a 90 kVp bench-top scanner can still see through.
"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.simulate.blocks import domed_cylinder, strew
from tomo_polysplat.simulate.phantom import Part
from tomo_polysplat.simulate.shapes import Shape, box, cylinder, ellipsoid, rotation

__all__ = ["HALF_WIDTH", "parts"]

HALF_WIDTH = 3.6
BLOOD = 1.06


def parts() -> list[Part]:
    """The parts in cm, in order of precedence."""
    listed = [
        *domed_cylinder((3.35, 2.55), 2.2, 0.65, "adipose", 0.95),
        *domed_cylinder((3.10, 2.30), 2.2, 0.55, "muscle", 1.05),
        *_ribs(),
    ]
    for side in (-1, 1):
        lung = ellipsoid((1.45 * side, 0.1, 0.0), (1.15, 1.75, 2.45))
        listed.append(Part(lung, "lung", 0.26))
        listed += strew(
            ellipsoid(lung.centre, 0.95 * lung.semi), 60, "lung", (0.18, 0.36), (0.08, 0.25), seed=3 + side
        )
        listed += _vessels(lung, side)
    heart = ellipsoid((0.35, 0.55, -0.5), (0.95, 0.80, 1.15), rotation((0.3, 1.0, 0.2), 30))
    listed += [
        Part(heart, "muscle", 1.05),
        Part(
            ellipsoid((0.45, 0.55, -0.5), (0.50, 0.42, 0.70), rotation((0.3, 1.0, 0.2), 30)), "blood", BLOOD
        ),
        Part(cylinder((-0.1, -0.75, 0.0), 0.24, 2.5), "blood", BLOOD),
        Part(cylinder((0.0, -0.2, 1.6), 0.20, 0.9), "water", 0.0),
        *(Part(ellipsoid((0.9 * s, 0.9 * s, 0.9), 0.16), "muscle", 1.10) for s in (-1, 1)),
    ]
    return listed + _spine() + _implant()


def _ribs() -> list[Part]:
    """Chains of ellipsoids round the chest, sloping down to the front, with a marrow of lower density."""
    listed = []
    for level in np.arange(-2.1, 2.2, 0.7).tolist():
        for angle in np.deg2rad(np.arange(-70, 251, 10)):
            tangent = np.degrees(np.arctan2(2.05 * np.cos(angle), -2.85 * np.sin(angle)))
            turn = rotation((0, 0, 1), float(tangent))
            place = (2.85 * np.cos(angle), 2.05 * np.sin(angle), level - 0.25 * np.sin(angle))
            listed.append((ellipsoid(place, (0.32, 0.09, 0.14), turn), 1.70))
            listed.append((ellipsoid(place, (0.24, 0.045, 0.08), turn), 1.15))
    # All marrow after all cortex, or the ends of the links would close it off.
    return [Part(shape, "bone", density) for shape, density in sorted(listed, key=lambda link: -link[1])]


def _vessels(lung: Shape, side: int) -> list[Part]:
    """Two generations of branches from the hilum outwards, thinning."""
    generator = np.random.default_rng(40 + side)
    hilum = lung.centre + (-0.75 * side, 0.0, 0.0)
    listed = []
    for _ in range(14):
        end = lung.centre + 0.62 * lung.semi * _unit(generator)
        listed.append(_rod(hilum, end, 0.06))
        for _ in range(3):
            tip = end + 0.28 * lung.semi * _unit(generator)
            listed.append(_rod(end, tip, 0.03))
    return [Part(shape, "blood", BLOOD) for shape in listed]


def _unit(generator: np.random.Generator) -> np.ndarray:
    vector = generator.standard_normal(3)
    return vector / np.linalg.norm(vector)


def _rod(start: np.ndarray, stop: np.ndarray, radius: float) -> Shape:
    return cylinder((start + stop) / 2, radius, float(np.linalg.norm(stop - start)) / 2, stop - start)


def _spine() -> list[Part]:
    listed = []
    for level in np.arange(-2.1, 2.2, 0.7).tolist():
        listed += [
            Part(cylinder((0, -1.45, level), (0.50, 0.40), 0.27), "bone", 1.65),
            Part(cylinder((0, -1.45, level), (0.42, 0.32), 0.21), "bone", 1.22),
            Part(box((0, -1.98, level), (0.55, 0.20, 0.20)), "bone", 1.60),
            Part(box((0, -2.20, level - 0.05), (0.07, 0.18, 0.18)), "bone", 1.60),
        ]
    return [*listed, Part(cylinder((0, -1.93, 0), 0.15, 2.5), "water", 1.03)]


def _implant() -> list[Part]:
    """Two screws into one vertebra, joined on each side by a rod to the next level."""
    listed = []
    for side in (-1, 1):
        screw = cylinder((0.30 * side, -1.75, 0.0), 0.09, 0.42, (-0.25 * side, 1.0, 0.0))
        rod = cylinder((0.42 * side, -2.18, 0.35), 0.11, 0.75)
        listed += [Part(screw, "iron", 7.87, metal=True), Part(rod, "iron", 7.87, metal=True)]
    return listed

"""Pancreas: an abdomen with liver, kidneys, bowel, vessels, spine and a lobed pancreas with titanium in it.

Scaled to 7 cm, which a 90 kVp bench-top scanner can still see through.
"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.simulate.blocks import domed_cylinder, strew
from tomo_polysplat.simulate.phantom import Part
from tomo_polysplat.simulate.shapes import box, cylinder, ellipsoid, rotation

__all__ = ["HALF_WIDTH", "parts"]

HALF_WIDTH = 3.6


def parts() -> list[Part]:
    """The parts in cm, in order of precedence."""
    liver = ellipsoid((-1.45, 0.55, 0.4), (1.25, 1.15, 1.75), rotation((0, 0, 1), 25))
    listed = [
        *domed_cylinder((3.30, 2.45), 2.2, 0.65, "adipose", 0.95),
        *domed_cylinder((3.05, 2.20), 2.2, 0.55, "muscle", 1.05),
        Part(cylinder((0, 0.25, 0), (2.80, 1.75), 2.0), "adipose", 0.94),
        Part(liver, "muscle", 1.07),
        *strew(liver, 45, "water", (1.00, 1.09), (0.04, 0.12), seed=11),
        Part(ellipsoid((2.05, 0.15, 1.0), (0.60, 0.80, 1.05)), "muscle", 1.06),
    ]
    for side in (-1, 1):
        listed += [
            Part(ellipsoid((1.55 * side, -0.85, -0.7), (0.55, 0.48, 1.0)), "muscle", 1.05),
            Part(ellipsoid((1.45 * side, -0.80, -0.7), (0.24, 0.20, 0.6)), "water", 1.01),
        ]
    return listed + _bowel() + _pancreas() + _vessels() + _spine() + _clips()


def _bowel() -> list[Part]:
    """A stomach with an air bubble and loops of bowel, some with gas."""
    listed = [
        Part(ellipsoid((0.95, 1.25, 0.6), (0.95, 0.60, 0.75)), "muscle", 1.04),
        Part(ellipsoid((0.95, 1.25, 0.6), (0.83, 0.48, 0.63)), "water", 1.02),
        Part(ellipsoid((0.95, 1.45, 0.6), (0.55, 0.25, 0.40)), "water", 0.0),
    ]
    for n, angle in enumerate(np.deg2rad(np.arange(0, 360, 40))):
        place = (1.7 * np.cos(angle), 0.85 + 0.55 * np.sin(angle), -1.4)
        listed.append(Part(ellipsoid(place, (0.36, 0.30, 0.55)), "muscle", 1.05))
        filling = 0.0 if n % 3 == 0 else 1.0
        listed.append(Part(ellipsoid(place, (0.22, 0.18, 0.40)), "water", filling))
    return listed


def _pancreas() -> list[Part]:
    """Lobules along a curved line from head to tail, with fat between them and a duct."""
    generator = np.random.default_rng(12)
    listed = []
    for t in np.linspace(-1.0, 1.0, 90):
        line = np.array([1.25 * t, 0.15 + 0.25 * t - 0.35 * t**2, -0.1 + 0.35 * t])
        thick = 0.26 - 0.08 * t
        place = line + thick * generator.uniform(-0.8, 0.8, 3)
        shape = ellipsoid(place, generator.uniform(0.09, 0.17, 3))
        listed.append(Part(shape, "muscle", float(generator.uniform(1.01, 1.07))))
    duct = cylinder((0.0, 0.08, -0.1), 0.04, 1.1, (1.25, 0.25, 0.35))
    return [*listed, Part(duct, "water", 1.0)]


def _vessels() -> list[Part]:
    return [
        Part(cylinder((0.25, -0.75, 0.0), 0.22, 2.5), "blood", 1.06),
        Part(cylinder((-0.35, -0.70, 0.0), 0.26, 2.5), "blood", 1.06),
        Part(cylinder((0.3, -0.25, 0.1), 0.10, 1.3, (1.0, 0.1, 0.25)), "blood", 1.06),
    ]


def _spine() -> list[Part]:
    listed = []
    for level in np.arange(-2.0, 2.1, 1.0).tolist():
        listed += [
            Part(cylinder((0, -1.45, level), (0.58, 0.44), 0.40), "bone", 1.40),
            Part(cylinder((0, -1.45, level), (0.49, 0.35), 0.33), "bone", 1.15),
            Part(box((0, -1.98, level), (0.75, 0.14, 0.22)), "bone", 1.35),
        ]
    return [*listed, Part(cylinder((0, -1.95, 0), 0.15, 2.5), "water", 1.03)]


def _clips() -> list[Part]:
    """A thick stent across the head of the gland and two clips in its body."""
    stent = cylinder((-0.75, 0.0, -0.25), 0.24, 0.75, (0.35, 0.25, 1.0))
    bore = cylinder((-0.75, 0.0, -0.25), 0.07, 0.76, (0.35, 0.25, 1.0))
    clips = [box((x, y, z), (0.34, 0.14, 0.19), rotation((0.2, 0.3, 1.0), turn)) for x, y, z, turn in CLIPS]
    listed = [
        Part(stent, "titanium", 4.51, metal=True),
        *(Part(c, "titanium", 4.51, metal=True) for c in clips),
    ]
    return [*listed, Part(bore, "water", 1.0)]


CLIPS = ((0.25, 0.20, -0.05, 20.0), (0.85, 0.25, 0.15, 65.0))

"""Do the lengths make an object of possible matter?"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured
from tomo_polysplat.units import cm_per, density_in_doubt

__all__ = ["LENGTHS", "probe_lengths"]

LENGTHS = "unit of length"
# Water of more g/cm3 attenuates as metal does.
_METAL = 10.0
# -log(I/I0) of the darker rays from which there is matter that attenuates: an aerogel does not.
_ATTENUATES = 0.1
# Rays that show more than this share of the large values pass the object.
_OBJECT = 0.1
_NEEDS = "the unit and the size of a pixel, as the scanner has them"


def probe_lengths(measured: Measured) -> Finding:
    """How dense water would be that attenuates as the object does, whose size its shadow tells."""
    scan = measured.scan
    if scan.unit == "pixel" or scan.spectrum is None:
        needed = {"a spectrum": scan.spectrum is None, "the size of a pixel": scan.unit == "pixel"}
        lacking = [words for words, missing in needed.items() if missing]
        text = f"without {' and '.join(lacking)} there is no density to look at"
        return Finding(LENGTHS, UNKNOWN, text, ", and ".join(lacking))
    if measured.air is None:
        text = "without air on both sides the size of the object is not told"
        return Finding(LENGTHS, UNKNOWN, text, _NEEDS)
    density = _as_water(measured)
    numbers = {"density": density}
    text = f"the object attenuates like water of {density:.2g} g/cm3 would"
    doubt = density_in_doubt(density, scan.unit)
    if doubt is not None:
        certain = doubt.impossible and float(np.percentile(measured.filled, 95)) > _ATTENUATES
        return Finding(LENGTHS, DEFECT if certain else UNKNOWN, doubt.words, doubt.remedy, numbers)
    if density > _METAL:
        return Finding(LENGTHS, UNKNOWN, f"{text}: right for metal", _NEEDS, numbers)
    return Finding(LENGTHS, OK, text, "", numbers)


def _as_water(measured: Measured) -> float:
    """Mass of water in the slices with most matter, over the area of a disc as wide as their shadow, in g/cm3."""
    # Not needed by the other probes.
    from tomo_polysplat.physics.water import areal_density

    values, spectrum = measured.filled, measured.scan.spectrum
    assert spectrum is not None and measured.air is not None
    most = np.argsort(values.mean(axis=(1, 2)))[-max(1, len(values) // 8) :]
    areal = areal_density(values[most] - measured.air.level, spectrum)
    pixel = float(measured.geometry.pixel_size_at(measured.grid.centre)[0]) * cm_per(measured.scan.unit)
    inside = areal > _OBJECT * np.percentile(areal, 99)
    width = pixel * inside.sum(axis=2).mean(axis=1)
    # Beside metal that hardly any light passes, a slice of light matter alone has no shadow.
    shown = width > 0
    mass = pixel * areal.sum(axis=2).mean(axis=1)
    return float(np.median(mass[shown] / (0.25 * math.pi * width[shown] ** 2)))

"""Absorption edges inside a spectrum."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.physics.materials import MaterialLike, mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["edge_inside"]

# An edge matters where at least this share of the spectrum lies on either side of it.
_SHARE = 0.1
_STEP_KEV = 0.05
# Between edges attenuation falls; a rise by this factor from a step to the next is one.
_RISE = 1.2


def edge_inside(material: MaterialLike, spectrum: Spectrum) -> float | None:
    """Energy in keV of the first absorption edge of a material that divides a spectrum, or None."""
    below = np.cumsum(spectrum.weights) / spectrum.weights.sum()
    low, high = np.interp([_SHARE, 1 - _SHARE], below, spectrum.energies)
    energies = np.arange(low, high, _STEP_KEV)
    if len(energies) < 2:
        return None
    attenuation = mass_attenuation(material, energies)
    rises = np.flatnonzero(attenuation[1:] > _RISE * attenuation[:-1])
    return float(energies[rises[0] + 1]) if len(rises) else None

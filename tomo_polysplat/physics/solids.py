"""Material numbers of solids that are all an object is made of."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.physics.materials import mass_attenuation

__all__ = ["number_of_solid"]

# Densities in g/cm3, and the numbers that `best_stand_in` finds from 60 to 160 kV with the default curves, within 0.05.
# At the attenuation of aluminium and up to a third more, ceramics have 0.17 to 0.25, limestone and basalt 0.38 to 0.43.
_SOLIDS = {"SiO2": (2.65, 0.20), "aluminium": (2.70, 0.27), "titanium": (4.51, 0.77), "iron": (7.87, 1.0)}


def number_of_solid(level: np.ndarray | float, energy_kev: float) -> np.ndarray:
    """The default curves' material numbers of solids, by their attenuation.

    Light elements are mostly light solids, so that the attenuation tells the one from the other: between quartz,
    aluminium, titanium and iron the number goes with its logarithm.

    Parameters
    ----------
    level : array or float
        Attenuation in multiples of that of water of 1 g/cm3.
    energy_kev : float
        At which energy.
    """
    water = float(mass_attenuation("water", energy_kev))
    levels = [
        grams * float(mass_attenuation(name, energy_kev)) / water for name, (grams, _) in _SOLIDS.items()
    ]
    numbers = [number for _, number in _SOLIDS.values()]
    return np.interp(np.log(np.maximum(level, 1.0)), np.log(levels), numbers)

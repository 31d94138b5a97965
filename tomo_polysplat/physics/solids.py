"""Material numbers of solids that are all an object is made of."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.physics.materials import density, mass_attenuation

__all__ = ["number_of_solid"]

# What `best_stand_in` finds at 90 kV with the default curves; the same within 0.05 from 60 to 160 kV. Stone and bone
# have 0.2 to 0.35, and are as dense to x-rays as aluminium or less.
_NUMBERS = {"aluminium": 0.27, "titanium": 0.77, "iron": 1.0}


def number_of_solid(level: float, energy_kev: float) -> float:
    """The default curves' material number of a solid, by its attenuation.

    Light elements are light solids, so that the attenuation tells the one from the other: between aluminium, titanium
    and iron the number goes with its logarithm.

    Parameters
    ----------
    level : float
        Attenuation in multiples of that of water of 1 g/cm3.
    energy_kev : float
        At which energy.
    """
    water = float(mass_attenuation("water", energy_kev))
    levels = [density(name) * float(mass_attenuation(name, energy_kev)) / water for name in _NUMBERS]
    return float(np.interp(np.log(max(level, 1.0)), np.log(levels), list(_NUMBERS.values())))

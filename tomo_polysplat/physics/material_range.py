"""How far below the soft curve material numbers may go."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["LEAST_U", "least_material_number"]

# Fat and plastics harden a beam less than water does: their curve is the mixture's continued a little below 0.
LEAST_U = -0.1
# Below 0 the mixture takes the middle curve away; at every energy so much of the soft one must be left.
_LEAST_SHARE = 0.1
# Energies with less than this share of the spectrum's largest weight do not count.
_FLOOR = 1e-3
_STEPS = 100


def least_material_number(materials: Materials, spectrum: Spectrum, nodes: np.ndarray) -> float:
    """The least material number whose mixtures attenuate at every energy, from `LEAST_U` to 0.

    Parameters
    ----------
    materials : Materials
    spectrum : Spectrum
    nodes : (3, n) array
        Attenuation of the curves at the nodes that stand for the spectrum.
    """
    lit = spectrum.weights > _FLOOR * spectrum.weights.max()
    energies = np.append(spectrum.energies[lit], spectrum.effective_energy)
    curves = np.concatenate([materials.mass_attenuation(energies), nodes], axis=1)
    numbers = np.linspace(LEAST_U, 0.0, _STEPS + 1)
    mixed = np.einsum("ku,kn->un", Materials.mixture(numbers), curves)
    fails = np.flatnonzero((mixed < _LEAST_SHARE * curves[0]).any(axis=1))
    return float(numbers[fails[-1] + 1]) if len(fails) else LEAST_U

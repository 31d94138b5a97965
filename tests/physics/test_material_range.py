"""Mixtures below the soft curve attenuate at every energy, whatever the three materials are."""

import numpy as np
import pytest

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.material_range import LEAST_U, least_material_number
from tomo_polysplat.physics.quadrature import fit_quadrature
from tomo_polysplat.physics.spectrum import Spectrum

SPECTRUM = Spectrum.from_tube(90, filters={"Al": 0.1})


@pytest.mark.parametrize(
    "names", [("water", "bone", "iron"), ("water", "iodine", "iron"), ("PMMA", "iron", "tungsten")]
)
def test_every_mixture_attenuates_at_every_energy_and_node(names):
    materials = Materials.of(names)
    nodes = fit_quadrature(SPECTRUM, materials, max_path=6.0).attenuation
    least = least_material_number(materials, SPECTRUM, nodes)
    assert LEAST_U <= least <= 0
    lit = SPECTRUM.weights > 1e-3 * SPECTRUM.weights.max()
    curves = np.concatenate([materials.mass_attenuation(SPECTRUM.energies[lit]), nodes], axis=1)
    numbers = np.linspace(least, 1.0, 301)
    shares = np.einsum("ku,kn->un", Materials.mixture(numbers), curves) / curves[0]
    assert shares.min() >= 0.099
    if least > LEAST_U:  # a step further some energy would have less than the tenth that is asked for
        beyond = np.einsum("k,kn->n", Materials.mixture(least - 2e-3), curves) / curves[0]
        assert beyond.min() < 0.1


def test_the_usual_curves_keep_the_whole_range_and_dense_ones_do_not():
    def least(*names):
        return least_material_number(Materials.of(names or None), SPECTRUM, np.ones((3, 0)))

    assert least() == LEAST_U
    # f(u) = (1-u)^2 + 2u(1-u) r falls to a tenth where 2 |u| r is about 0.9.
    curves = Materials.of(("water", "iodine", "iron")).mass_attenuation(SPECTRUM.energies)
    lit = SPECTRUM.weights > 1e-3 * SPECTRUM.weights.max()
    ratio = (curves[1] / curves[0])[lit].max()
    assert least("water", "iodine", "iron") == pytest.approx(-0.45 / ratio, rel=0.25)

"""Pieces of metal get the number of the solid that is as dense as they come out."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from small_clouds import blocks, scene_of
from small_scans import disc

from tomo_polysplat import reconstruct
from tomo_polysplat.fit.metal_numbers import number_metals
from tomo_polysplat.fit.metal_voxels import levels_of_pieces
from tomo_polysplat.physics.materials import density
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.settings import Settings


def test_each_piece_gets_the_number_of_its_own_attenuation():
    gaussians, box = blocks([1.0, 10.0, 40.0])
    # Linear, so that what comes out is what the blocks' attenuation was taken to be.
    number_metals(gaussians, scene_of(box, lambda levels: levels / 100), Settings(), 0.1)
    # Of eleven Gaussians an edge most are not at the rim, where voxels hold less.
    assert gaussians.shared_material.tolist() == pytest.approx([0.0, 0.1, 0.4], rel=0.03)


def test_the_level_of_a_piece_is_the_median_of_its_voxels():
    """Of even and odd numbers of them, in any order; a piece that is gone has none."""
    rng = np.random.default_rng(3)
    values, index, group = (
        rng.normal(size=(3, 5, 7)),
        rng.integers(0, 3, (41, 3)),
        rng.permutation([1, 2, 4] * 14)[:41],
    )
    metal = SimpleNamespace(group=torch.from_numpy(group))
    pieces, levels, of_each = levels_of_pieces(metal, torch.from_numpy(values), torch.from_numpy(index))
    own = values[tuple(index.T)]
    assert pieces.tolist() == [1, 2, 4] and torch.equal(pieces[of_each], metal.group)
    assert levels.tolist() == pytest.approx([np.median(own[group == piece]) for piece in (1, 2, 4)])


@pytest.mark.parametrize("share, known", [(0.4, True), (0.1, False)])
def test_numbers_stay_once_they_are_fitted_and_where_nothing_tells_them(share, known):
    gaussians, box = blocks([1.0, 10.0])
    number_metals(
        gaussians, scene_of(box, (lambda levels: levels / 100) if known else None), Settings(), share
    )
    assert gaussians.shared_material.tolist() == pytest.approx([0.0, 0.8])


@pytest.mark.parametrize("metal, least, most", [("iron", 0.93, 1.0), ("titanium", 0.7, 0.88)])
def test_iron_and_titanium_are_told_apart(metal, least, most):
    spectrum = Spectrum.from_tube(160, filters={"Cu": 0.05})
    settings = {"passes": 10.0, "views_per_step": 10, "tv_factor": 1.0, "gains": False, "drift": False}
    options = {"spectrum": spectrum, "unit": "cm", "settings": settings, "align": False, "calibrate": False}
    result = reconstruct(*disc(metal, spectrum), progress=False, **options)
    numbers = result.gaussians["u"][result.gaussians["density"] > 0.5 * density(metal)]
    assert len(numbers) > 20 and least < np.median(numbers) <= most

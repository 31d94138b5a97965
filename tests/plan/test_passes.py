"""How long a run is: by how many views there are, and by how many Gaussians."""

from types import SimpleNamespace

import numpy as np
import pytest

from tomo_polysplat.plan.decisions.passes import Passes
from tomo_polysplat.plan.decisions.seed_spacing import SeedSpacing
from tomo_polysplat.settings import Settings


def _passes(seeds, views, planar=False):
    grid = SimpleNamespace(voxel_size=np.ones(3))
    problem = SimpleNamespace(
        planar=planar,
        dimensions=2 if planar else 3,
        grid=grid,
        voxel=1.0,
        geometry=SimpleNamespace(views=views),
    )
    lab = SimpleNamespace(problem=problem, support=seeds, settings=Settings())
    return Passes().ask({SeedSpacing: 1.0}, lab).value


def test_a_very_large_cloud_uses_so_many_views_in_all_and_no_other_less_than_usual():
    assert [_passes(seeds, 1500) for seeds in (1e5, 9e6)] == [15.0, 15.0]
    assert _passes(2e7, 1500) * 1500 == pytest.approx(9000)
    # Few views are not used more often for that, and very many still a few times each.
    assert _passes(2e7, 300) == 15.0
    assert _passes(2e7, 9000) == 4.0


def test_few_seeds_or_views_make_longer_runs():
    assert _passes(1e3, 100) == pytest.approx(20.0)
    assert _passes(1e5, 15) == pytest.approx(45.0)
    assert _passes(1e5, 400, planar=True) == 10.0

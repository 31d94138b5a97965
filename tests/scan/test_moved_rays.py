"""Where rays of a moved detector fall on the one that stays: by points that both see."""

import numpy as np
import pytest
import torch
from test_moves import orbit

from tomo_polysplat.scan.moved_rays import FALLS, falls_of, falls_on
from tomo_polysplat.scan.moves import Scanner

POINTS = torch.from_numpy(np.random.default_rng(2).uniform(-0.3, 0.3, (6, 3)))


@pytest.mark.parametrize("beam", ["cone", "parallel"])
@pytest.mark.parametrize("name", FALLS)
def test_a_point_seen_by_a_pixel_of_the_moved_detector_is_seen_where_the_ray_falls(beam, name):
    scanner, step = Scanner(orbit(beam)), 1e-5
    at = {"u": torch.tensor(0.7).double(), "roll": torch.tensor(2.0).double()}
    falls = falls_of(scanner, at, [name])
    there = scanner.project(at, POINTS)
    moved = scanner.project({**at, name: at.get(name, 0.0) + torch.tensor(step).double()}, POINTS)
    for view in range(len(there)):
        for k in range(len(POINTS)):
            across, down = falls_on(falls, moved[view, k, :1], moved[view, k, 1:])
            told = torch.stack([across[0, view, 0, 0], down[0, view, 0, 0]])
            torch.testing.assert_close(told, (there - moved)[view, k] / step, rtol=1e-4, atol=1e-4)

"""Where a Gaussian stands in the list decides how fast the kernels are, and nothing else."""

import numpy as np
import pytest
import torch
from small_scans import QUICK, cone, fan, reconstruct

from tomo_polysplat.kernels.spatial_order import spatial_order

MOVING = QUICK | {"passes": 4.0, "relocate_until": 1.0, "relocated": 0.1}


def steps_along_the_list(position):
    return float(np.linalg.norm(np.diff(position, axis=0), axis=1).mean())


def test_gaussians_that_were_moved_stand_beside_their_new_neighbours():
    result = reconstruct(cone(), settings=MOVING)
    assert result.counts["gaussians_relocated"] > 0.1 * result.counts["gaussians"]
    position = np.asarray(result.gaussians["position"])
    sorted_anew = position[spatial_order(torch.tensor(position)).numpy()]
    assert steps_along_the_list(position) < 1.2 * steps_along_the_list(sorted_anew)


def test_any_order_gives_the_same_volume(monkeypatch):
    ours = reconstruct(fan(), settings=MOVING)
    generator = torch.Generator().manual_seed(3)
    shuffled = "tomo_polysplat.fit.fitter.spatial_order"
    monkeypatch.setattr(shuffled, lambda position: torch.randperm(len(position), generator=generator))
    other = reconstruct(fan(), settings=MOVING)
    assert not np.array_equal(other.gaussians["position"], ours.gaussians["position"])
    assert other.volume == pytest.approx(ours.volume, abs=2e-3 * float(ours.volume.max()))

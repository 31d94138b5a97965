"""Fits shared out over two GPUs, and one on the second GPU alone: the same volume."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from shared_out import ROUGH, SMOOTHED, SUMS, assert_sums_are_those_of_one, reconstruct, relative, told_to
from small_scans import cone, fan

from tomo_polysplat.fit import volume_by_ranks
from tomo_polysplat.rank_processes import sharing
from tomo_polysplat.ranks import ALONE, current_ranks, led_by
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.start import bridged, fdk_by_ranks, projected
from tomo_polysplat.start.initial import initial_volume_on

sys.path.append(str(Path(__file__).parent / "kernels"))
from step_scenes import fit_problem

pytestmark = [
    pytest.mark.gpu,
    pytest.mark.skipif(torch.cuda.device_count() < 2, reason="there is one GPU at most"),
]


@pytest.mark.parametrize("scan", [cone, fan])
def test_two_gpus_make_the_volume_of_one(scan):
    shared, one = (
        reconstruct(scan(), settings=ROUGH, **on) for on in ({"devices": [0, 1]}, {"device": "cuda:0"})
    )
    assert shared.plan["ranks"].value == 2
    assert relative(shared.volume, one.volume) < SMOOTHED


def test_the_second_gpu_alone_makes_the_volume_of_the_first():
    """Torch hands out to ASTRA what is on the current GPU, which is the first one."""
    first, second = (reconstruct(cone(), settings=ROUGH, device=f"cuda:{k}") for k in range(2))
    assert relative(second.volume, first.volume) < SMOOTHED


@pytest.fixture(scope="class")
def two_gpus():
    """Two processes on a GPU each, which have begun to make something together."""
    with sharing([torch.device("cuda", k) for k in range(2)]):
        with current_ranks().together():
            pass
        yield current_ranks()


class TestTwoGpus:
    """What they make beside steps is what one makes."""

    def test_make_the_first_volume_and_bridge_metal(self, two_gpus, monkeypatch):
        for module in (fdk_by_ranks, projected):
            monkeypatch.setattr(module, "_WORTH", 0)
        geometry, grid = from_astra(cone(metal=True).proj_geom, cone(metal=True).vol_geom)
        values = torch.from_numpy(projections_from_astra(cone(metal=True).projections, cone().proj_geom))
        values, told = values.to(two_gpus.device), told_to(two_gpus, monkeypatch)

        def made():
            first, _ = initial_volume_on(values, geometry, grid)
            metal = 0.5 * float(first.max())
            return first, *bridged.bridged_start(values, first, "fdk", geometry, grid, metal=metal)

        *shared, how = made()
        assert told == ["work"] * 7 and "through metal bridged" in how
        with led_by(ALONE):
            *one, _ = made()
        for together, alone in zip(shared, one):
            # ASTRA interpolates with weights of eight bits.
            assert together.device == two_gpus.device
            assert relative(together.cpu().numpy(), alone.cpu().numpy()) < 5e-3

    @pytest.mark.parametrize("sums", SUMS)
    def test_add_up_residuals(self, two_gpus, monkeypatch, sums):
        fit = fit_problem("cone", True, "cuda:0", "triton", filtered=True)
        assert_sums_are_those_of_one(sums, fit, two_gpus, monkeypatch, within=1e-4)

    def test_make_slices_of_the_volume(self, two_gpus, monkeypatch):
        monkeypatch.setattr(volume_by_ranks, "_WORTH", 0)
        fit, told = fit_problem("cone", True, "cuda:0", "triton"), told_to(two_gpus, monkeypatch)
        parts = fit.gaussians.copy(), 0.3
        shared = fit.scene.basis_on_host(*parts)
        assert told == ["work"]
        with led_by(ALONE):
            one = fit.scene.basis_on_host(*parts)
        np.testing.assert_allclose(shared, one, rtol=1e-4, atol=1e-5 * one.max())

"""Projecting voxels: gradient and adjoint on the CPU, and ASTRA's pair against ours on a GPU."""

import numpy as np
import pytest
import torch

from tomo_polysplat.baselines.arrays.sirt import sirt
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.simulate.scenes import simulate_scan
from tomo_polysplat.start.astra_pair import AstraPair
from tomo_polysplat.start.voxel_projector import project_voxels, projector_pair

VIEWS = np.array([1, 4, 5])


def scene(size=17, views=7, rows=13, columns=19):
    scan = simulate_scan("pins", size, views, noise=False, rows=rows, columns=columns)
    return scan, *from_astra(scan.proj_geom, scan.vol_geom)


def random(*shape, device="cpu"):
    return torch.rand(shape, generator=torch.Generator().manual_seed(len(shape))).to(device)


def test_the_gradient_is_the_adjoint():
    _, geometry, grid = scene()
    volumes = random(3, *grid.shape).requires_grad_()
    with projector_pair(geometry, grid, torch.device("cpu")) as pair:
        image = project_voxels(volumes, pair, VIEWS)
        assert image.shape == (3, 3, 13, 19)
        cotangent = random(*image.shape)
        (gradient,) = torch.autograd.grad(image, volumes, cotangent)
        for k in range(3):
            torch.testing.assert_close(image[k], pair.forward(volumes[k].detach(), VIEWS))
    # A linear map: <A x, y> = <x, A' y>, up to the rounding of float32 sums.
    left, right = ((a.detach().double() * b).sum() for a, b in ((image, cotangent), (volumes, gradient)))
    assert float(left) == pytest.approx(float(right), rel=1e-5)


@pytest.mark.gpu
def test_astra_projects_like_our_own():
    # Pixels of half a voxel: with fewer, our rays leave voxels out that ASTRA's backprojection interpolates.
    _, geometry, grid = scene(size=33, views=9, rows=79, columns=83)
    volume = random(*grid.shape)
    # Noise has no place for a difference of interpolation to hide in; a smooth volume has the scale.
    smooth = torch.nn.functional.avg_pool3d(volume[None, None], 5, 1, 2)[0, 0]
    with projector_pair(geometry, grid, torch.device("cpu")) as pair:
        expected = pair.forward(smooth, VIEWS)
        spread = pair.adjoint(expected, VIEWS)
    with projector_pair(geometry, grid, torch.device("cuda")) as pair:
        assert isinstance(pair, AstraPair)
        image = pair.forward(smooth.cuda(), VIEWS)
        back = pair.adjoint(expected.cuda().contiguous(), VIEWS)
        again = pair.forward(smooth.cuda(), VIEWS)
    assert float((image.cpu() - expected).norm() / expected.norm()) < 0.02
    inner = (slice(8, -8),) * 3
    back, spread = (torch.nn.functional.avg_pool3d(v[None], 3, 1, 1)[0][inner] for v in (back.cpu(), spread))
    assert float((back - spread).norm() / spread.norm()) < 0.05
    assert torch.equal(image, again)


@pytest.mark.gpu
def test_gradient_through_astra():
    _, geometry, grid = scene(size=33, views=9)
    volumes = random(3, *grid.shape, device="cuda").requires_grad_()
    with projector_pair(geometry, grid, torch.device("cuda")) as pair:
        image = project_voxels(volumes, pair, VIEWS)
        cotangent = random(*image.shape, device="cuda")
        (gradient,) = torch.autograd.grad(image, volumes, cotangent)
    left, right = ((a.detach().double() * b).sum() for a, b in ((image, cotangent), (volumes, gradient)))
    # ASTRA's backprojection is driven by voxels, its projection by rays: adjoint but for the interpolation.
    assert float(left) == pytest.approx(float(right), rel=0.03)


@pytest.mark.gpu
def test_sirt_of_astra_agrees_with_ours():
    # Rays enough to determine every voxel: what they leave open, each algorithm fills in its own way.
    scan, geometry, grid = scene(size=33, views=40, rows=49, columns=53)
    projections = projections_from_astra(scan.projections, scan.proj_geom).copy()
    projections[::5, 3, 4] = np.nan
    ours, theirs = (sirt(projections, geometry, grid, iterations=20, device=d) for d in ("cpu", "cuda"))
    assert theirs.max() > 0
    assert np.linalg.norm(theirs - ours) < 0.1 * np.linalg.norm(ours)

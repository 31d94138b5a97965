"""The rays near metal: they are those of the whole detector, and no ray at metal is left out."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.close_up import close_up
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.render.renderer import project_gaussians

VIEWS, ROWS, COLUMNS = 7, 19, 23


def views_of(cone):
    """Views around the z axis."""
    angle = np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)
    out = np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)
    across = np.stack([-np.sin(angle), np.cos(angle), 0 * angle], axis=1) * 0.1
    up = np.tile([0.0, 0.0, 0.1], (VIEWS, 1))
    corner = -across * (COLUMNS - 1) / 2 - up * (ROWS - 1) / 2
    if cone:
        return DetectorViews(True, -4 * out, np.stack([across, up, 5 * out + corner], axis=2), ROWS, COLUMNS)
    return DetectorViews(False, corner - 4 * out, np.stack([across, up, out], axis=2), ROWS, COLUMNS)


def cloud(position, group):
    n = len(position)
    parts = {
        "position": torch.tensor(position),
        "log_scale": torch.full((n, 3), np.log(0.06)),
        "rotation": torch.tensor([[1.0, 0.0, 0.0, 0.0]] * n),
        "attenuation": torch.ones(n),
        "own_material": torch.zeros(n),
        "shared_material": torch.zeros(2),
        "group": torch.tensor(group),
        "blur": torch.zeros(1),
    }
    return Gaussians(**parts)


@pytest.mark.parametrize("cone", [True, False])
def test_a_part_of_the_detector_sees_what_it_sees_of_the_whole(cone):
    views = views_of(cone)
    gaussians = cloud([[0.2, 0.1, 0.3], [-0.3, 0.2, -0.1]], [0, 1])
    whole, _ = project_gaussians(gaussians, gaussians.attenuation[None], views, "reference")
    dimmed = torch.arange(ROWS * COLUMNS).reshape(ROWS, COLUMNS) / 1000
    rays = Rays(whole[0], views, 1e4, 0.01, 0.0, dimmed=dimmed)
    chosen, rows, columns = np.array([1, 4, 6]), slice(3, 14), slice(5, 21)
    part = rays.part(chosen, rows, columns)
    seen, _ = project_gaussians(gaussians, gaussians.attenuation[None], part.views, "reference")
    assert whole[0].max() > 0.1
    torch.testing.assert_close(seen[0], whole[0][chosen][:, rows, columns], atol=2e-6, rtol=1e-5)
    assert torch.equal(part.projections, whole[0][chosen][:, rows, columns])
    assert torch.equal(part.dimmed, dimmed[rows, columns])


def run_of(gaussians):
    views = views_of(True)
    rays = Rays(torch.zeros(VIEWS, ROWS, COLUMNS), views, 1e4, 0.01, 0.0)
    return SimpleNamespace(gaussians=gaussians, rays=rays, scene=SimpleNamespace(kernel="reference"))


def test_the_window_holds_every_ray_at_metal_and_little_else():
    gaussians = cloud([[0.1, 0.0, 0.4], [-0.3, 0.2, -0.1]], [1, 0])
    run = run_of(gaussians)
    near = close_up(run, VIEWS)
    metal = gaussians.select(torch.tensor([0]))
    whole, seen = (
        project_gaussians(metal, metal.attenuation[None], views, "reference")[0].sum()
        for views in (run.rays.views, near.rays.views)
    )
    assert whole > 1
    torch.testing.assert_close(seen, whole, rtol=1e-4, atol=0)
    assert near.rays.projections[0].numel() < 0.7 * ROWS * COLUMNS


def test_some_views_are_spread_over_the_scan():
    near = close_up(run_of(cloud([[0.0, 0.0, 0.0]], [1])), 4)
    assert np.array_equal(near.rays.views.origin, views_of(True).origin[[0, 2, 4, 6]])


def test_there_is_no_window_without_metal():
    assert close_up(run_of(cloud([[0.0, 0.0, 0.0]], [0])), VIEWS) is None

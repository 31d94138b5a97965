"""Objects whose edges are known to be sharp or blurred, and when nobody needs to ask."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from tomo_polysplat import reconstruct
from tomo_polysplat.fit.first_volume import first_volume
from tomo_polysplat.fit.plan import make_plan
from tomo_polysplat.fit.plan_seeds import closer_spacing
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.sharpness import seeds_for_edges
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, to_astra
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.joseph import JosephProjector

SIZE, FINER = 31, 3
OPTIONS = {"seed": 0, "time_budget": None}


def walls(blur, views=44, size=SIZE):
    """Projections, geometry, grid and truth of nested shells, as they are or blurred by ``blur`` voxels."""
    angles = np.linspace(0, np.pi, views, endpoint=False)
    zero, step = 0 * angles, 2 / (1.4 * size)
    u = step * np.stack([np.cos(angles), np.sin(angles), zero], 1)
    v = step * np.tile([0.0, 0, 1], (views, 1))
    pixels = round(1.4 * size)
    corner = -0.5 * (pixels - 1) * (u + v)
    ray = np.stack([-np.sin(angles), np.cos(angles), zero], 1)
    geometry = Geometry("parallel", ray, corner, u, v, pixels, pixels)
    fine = VolumeGrid((FINER * size,) * 3, -np.ones(3), np.ones(3))
    z, y, x = np.meshgrid(*fine.axes()[::-1], indexing="ij")
    far = np.sqrt(x**2 + (1.2 * y) ** 2 + (z - 0.1) ** 2)
    object_ = np.where((far < 0.85) & (far > 0.68) | (far < 0.45) & (far > 0.3), 0.5, 0.0)
    object_ = ndimage.gaussian_filter(object_, FINER * blur)
    projections = JosephProjector(geometry, fine).forward(object_.astype(np.float32))
    noise = np.random.default_rng(0).normal(0, 0.003, projections.shape)
    truth = object_.reshape(size, FINER, size, FINER, size, FINER).mean(axis=(1, 3, 5))
    grid = VolumeGrid((size,) * 3, fine.lower, fine.upper)
    return (projections + noise).astype(np.float32), geometry, grid, truth


def told(scan, budget=None, **settings):
    """The plan with what is told of a scan's edges, and its seeds."""
    problem = Problem.of(*scan[:3], "cm", None, None)
    device, chosen = torch.device("cpu"), Settings(**settings)
    start, _ = first_volume(problem, device, chosen)
    plan = make_plan(start, problem, chosen, "cpu")
    scene, rays = problem.scene(plan, chosen, device), problem.rays(plan, chosen, device)
    options = OPTIONS | {"time_budget": budget}
    return seeds_for_edges(start, plan, problem, scene, rays, chosen, device, options)[:2]


@pytest.mark.parametrize("blur", [0.0, 1.2])
def test_two_short_fits_tell_sharp_edges_from_blurred_ones(blur):
    plan, seeds = told(walls(blur))
    assert plan.sharp == (blur == 0) and "after a short fit" in plan.reasons["edges"]
    # Thin seeds of a small cloud lie closer.
    assert plan.spacing == (1.15 if plan.sharp else 1.3)
    # As they were before the short fits, and thin where that was chosen.
    _, same = told(walls(blur), edges="sharp" if plan.sharp else "blurred")
    torch.testing.assert_close(seeds.parameters(), same.parameters(), rtol=0, atol=0)


def test_sharp_edges_come_out_sharper():
    projections, geometry, grid, truth = walls(0.0)
    proj_geom, vol_geom = to_astra(geometry, grid)
    rays = np.ascontiguousarray(projections.swapaxes(0, 1))

    def result(edges):
        return reconstruct(
            rays, proj_geom, vol_geom, unit="cm", settings={"edges": edges, "passes": 6}, progress=False
        )

    found, same, other = (result(edges) for edges in ("auto", "sharp", "blurred"))
    np.testing.assert_allclose(found.volume, same.volume, atol=1e-5)
    error, worse = (np.sqrt(np.mean((one.volume - truth) ** 2)) for one in (found, other))
    assert error < 0.8 * worse
    assert "sharp, and" in found.plan["edges"] and same.plan["edges"] == other.plan["edges"] == "asked for"


@pytest.mark.parametrize(
    "changed, because",
    [
        ({"edges": "sharp"}, "asked for"),
        ({"edges": "blurred"}, "asked for"),
        ({"seed_edge": 0.0}, "asked for"),
        ({"seed_spacing": 1.5}, "asked for"),
        ({"max_gaussians": 500}, "far from each other"),
        ({"passes": 5.0}, "so few passes"),
    ],
)
def test_nobody_asks_the_rays_where_it_is_known(changed, because):
    plan, _ = told(walls(0.0, views=41), **changed)
    assert plan.sharp == (changed == {"edges": "sharp"}) and because in plan.reasons["edges"]


@pytest.mark.parametrize(
    "spacing, seeds, asked, closer",
    [(1.3, 6000, 0.0, True), (1.3, 6001, 0.0, False), (1.7, 500, 0.0, False), (1.3, 500, 1.3, False)],
)
def test_only_a_small_cloud_at_the_usual_distance_lies_closer(spacing, seeds, asked, closer):
    found, why = closer_spacing(spacing, seeds, Settings(seed_spacing=asked))
    assert found == (1.15 if closer else spacing) and bool(why) == closer


def test_an_empty_scan_has_no_edges(caplog):
    projections, *rest = walls(0.0, views=41)
    plan, seeds = told((0 * projections, *rest))
    assert not plan.sharp and "empty" in plan.reasons["edges"] and not len(seeds) and not caplog.records


def test_few_views_few_voxels_and_little_time_do_not_tell():
    assert "fewer than 40 views" in told(walls(0.0, views=39))[0].reasons["edges"]
    assert "fewer than 30 voxels" in told(walls(0.0, views=41, size=29))[0].reasons["edges"]
    plan, _ = told(walls(0.0, views=41), budget=1e-6)
    assert not plan.sharp and "too short" in plan.reasons["edges"]

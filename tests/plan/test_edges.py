"""Objects whose edges are known to be sharp or blurred, and when nobody needs to ask."""

from functools import cache
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from planned import lab_of, planned, why
from scipy import ndimage

from tomo_polysplat import reconstruct
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan.decisions.agent import Agent
from tomo_polysplat.plan.decisions.closer_seeds import CloserSeeds
from tomo_polysplat.plan.decisions.detector_blur import DetectorBlur
from tomo_polysplat.plan.decisions.edges import Edges
from tomo_polysplat.plan.order import answer_to
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, to_astra
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.joseph import JosephProjector

SIZE, FINER = 31, 3


@cache
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
    lab = lab_of(Problem.of(*scan[:3], "cm", None, None), budget, **settings)
    for decision in (Agent(), Edges(), CloserSeeds()):
        lab.plan.answers[decision.name] = answer_to(decision, lab)
    return lab.plan, lab.seeds()


# They leave 0.44 and 1.27 to 1.33 by the noise, far from the bar of 0.96.
@pytest.mark.parametrize("blur", [0.0, 1.6])
def test_two_short_fits_tell_sharp_edges_from_blurred_ones(blur):
    plan, seeds = told(walls(blur))
    assert plan.sharp == (blur == 0) and "after a short fit" in why(plan, "edges")
    # Thin seeds of a small cloud lie closer.
    assert plan.spacing == (1.15 if plan.sharp else 1.3)
    # As they were before the short fits, and thin where that was chosen.
    _, same = told(walls(blur), edges="sharp" if plan.sharp else "blurred")
    torch.testing.assert_close(seeds.parameters(), same.parameters(), rtol=0, atol=0)


# After one pass thin seeds leave 1.03 and 1.08, after two 0.58 and 0.79: noise tells that light was spread.
@pytest.mark.parametrize("of", ["detector", "object"])
def test_a_blurred_detector_is_told_from_a_blurred_object(of):
    projections, *rest = walls(0.0 if of == "detector" else 0.6, views=60)
    if of == "detector":
        projections = ndimage.gaussian_filter(projections, (0, 0.8, 0.8))
    lab = lab_of(Problem.of(projections, *rest[:2], "cm", None, None), None)
    for decision in (Agent(), DetectorBlur(), Edges()):
        lab.plan.answers[decision.name] = answer_to(decision, lab)
    assert lab.plan.blurred and lab.plan.sharp == (of == "detector")


def test_sharp_edges_come_out_sharper():
    projections, geometry, grid, truth = walls(0.0)
    proj_geom, vol_geom = to_astra(geometry, grid)
    rays = np.ascontiguousarray(projections.swapaxes(0, 1))

    settings = {"passes": 6, "views_per_step": 22, "growth": 1.0, "gains": False, "drift": False}

    def result(edges):
        # Where the scanner stood is asked in other files.
        options = {"unit": "cm", "settings": settings | {"edges": edges}, "align": False}
        return reconstruct(rays, proj_geom, vol_geom, progress=False, **options)

    found, same, other = (result(edges) for edges in (None, "sharp", "blurred"))
    np.testing.assert_allclose(found.volume, same.volume, atol=1e-5)
    error, worse = (np.sqrt(np.mean((one.volume - truth) ** 2)) for one in (found, other))
    assert error < 0.8 * worse
    assert "sharp, and" in found.plan["edges"].why
    assert same.plan["edges"].why == other.plan["edges"].why == "asked for"


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
    assert plan.sharp == (changed == {"edges": "sharp"}) and because in why(plan, "edges")


@pytest.mark.parametrize(
    "spacing, seeds, asked, closer",
    [(1.3, 6000, None, 1.15), (1.3, 6001, None, 0.0), (1.7, 500, None, 0.0), (1.3, 500, 1.3, 0.0)],
)
def test_only_a_small_cloud_at_the_usual_distance_lies_closer(spacing, seeds, asked, closer):
    plan, settings = planned(edges="sharp", seed_spacing=spacing), Settings(seed_spacing=asked)
    lab = SimpleNamespace(plan=plan, settings=settings, seeds=lambda **assumed: range(seeds))
    assert answer_to(CloserSeeds(), lab).value == closer


def test_an_empty_scan_has_no_edges(caplog):
    projections, *rest = walls(0.0, views=41)
    plan, seeds = told((0 * projections, *rest))
    assert not plan.sharp and "empty" in why(plan, "edges") and not len(seeds) and not caplog.records


def test_few_views_few_voxels_and_little_time_do_not_tell():
    assert "fewer than 40 views" in why(told(walls(0.0, views=39))[0], "edges")
    assert "fewer than 30 voxels" in why(told(walls(0.0, views=41, size=29))[0], "edges")
    plan, _ = told(walls(0.0, views=41), budget=1e-6)
    assert not plan.sharp and "too short" in why(plan, "edges")

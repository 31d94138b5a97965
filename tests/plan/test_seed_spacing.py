"""How many Gaussians there are, how close and how thin, and what they cost."""

from dataclasses import fields

import numpy as np
import pytest
import torch
from planned import ball, lab_of, plan, problem, why

from tomo_polysplat.plan.decisions.agent import Agent
from tomo_polysplat.plan.decisions.closer_seeds import CloserSeeds
from tomo_polysplat.plan.decisions.edges import Edges
from tomo_polysplat.plan.first_gaussians import first_gaussians
from tomo_polysplat.plan.model import rays_of, scene_of
from tomo_polysplat.plan.order import alternatives, answer_to
from tomo_polysplat.render.renderer import project_gaussians
from tomo_polysplat.settings import Settings


def seeded(of, start, **settings):
    """The plan, its seeds, and what these cost."""
    chosen, device = plan(of, start, **settings), torch.device("cpu")
    return chosen, *first_gaussians(torch.as_tensor(start), chosen, of, Settings(**settings), device)


def test_seeds_are_no_closer_than_voxels_or_pixels_can_tell():
    fine = problem()
    assert plan(fine, ball(fine, 1)).spacing == pytest.approx(1.3)
    coarse = problem(pixel=2.0)
    assert plan(coarse, ball(coarse, 1)).spacing == pytest.approx(2.6)


@pytest.mark.parametrize("stretch", [(1, 1, 1), (1, 1, 5), (4, 1, 1)])
def test_the_number_of_seeds_keeps_its_bound_for_any_voxels(stretch):
    of = problem(stretch=stretch)
    start = np.full(of.grid.shape, of.depth, np.float32)
    chosen = plan(of, start, max_gaussians=100)
    volume = float(np.prod(of.grid.extent))
    assert volume / (chosen.spacing * of.voxel) ** 3 == pytest.approx(100)
    assert "100 Gaussians" in why(chosen, "seed_spacing")


def test_gaussians_may_be_thinner_where_they_are_few():
    of, flat = problem(32), problem(32, planar=True)
    assert plan(of, ball(of, 0.2)).smallest_scale == 0.2
    few = plan(of, ball(of, 0.2), max_gaussians=500)
    assert few.smallest_scale == 0.1 and "few" in why(few, "smallest_scale")
    assert plan(flat, ball(flat, 0.2), max_gaussians=50).smallest_scale == 0.2
    assert plan(of, ball(of, 0.2), max_gaussians=500, smallest_scale=0.35).smallest_scale == 0.35


def test_seeds_are_uneven_only_where_they_are_too_few():
    of = problem(32)
    start = ball(of, 0.2)
    assert plan(of, start).finer == 0.0
    assert plan(of, start, seed_spacing=2.5).finer == 0.0
    few = plan(of, start, max_gaussians=500)
    assert few.finer == Settings().finer_seeds and "50%" in why(few, "seed_spacing")
    assert plan(of, start, max_gaussians=500, finer_seeds=0.0).finer == 0.0


def most_gaussians(of, start, **settings):
    told = why(plan(of, start, "cuda", **settings), "seed_spacing")
    return int(told.split("at most ")[1].split()[0])


def test_a_gpu_seeds_by_the_surfaces_there_are():
    """Those of a ball grow by the square of its size; noise has none, and small volumes are seeded as ever."""
    small, large = problem(81), problem(121)
    few, many = (most_gaussians(of, ball(of, 1.0)) for of in (small, large))
    assert few == 60_000 < many
    half = 0.9**0.5 * 60  # radius in voxels
    noise = np.random.default_rng(0).normal(0, 0.4 * large.depth, large.grid.shape).astype(np.float32)
    noisy = ball(large, 1.0)
    noisy[noisy > 0] += noise[noisy > 0]
    assert most_gaussians(large, noisy) == pytest.approx(many, rel=0.1)
    layer = many / 1.7 / (4 * np.pi * half**2)
    assert 0.8 < layer < 2.0
    assert most_gaussians(large, ball(large, 1.0), max_gaussians=5000) == 5000
    assert "surfaces" not in why(plan(large, ball(large, 1.0)), "seed_spacing")
    tiny = problem(33)
    assert plan(tiny, ball(tiny, 1.0), "cuda").spacing == pytest.approx(1.3)


@pytest.mark.parametrize("share", [0.3, 0.5])
def test_uneven_seeds_are_as_many_as_even_ones(share):
    of = problem(32)
    start = ball(of, 0.2)
    even, uneven = (len(seeded(of, start, max_gaussians=1500, finer_seeds=s)[1]) for s in (0.0, share))
    # The rim of the support is whole cells, of either size.
    assert 0.8 * even < uneven < 1.2 * even


@pytest.mark.parametrize("planar", [True, False])
def test_alternatives_are_settings_by_name_and_say_what_they_cost(planar):
    of = problem(size=24, planar=planar, polychromatic=True)
    lab = lab_of(of)
    for kind in (Agent, Edges, CloserSeeds):
        lab.plan.answers[kind.name] = answer_to(kind(), lab)
    told, count = alternatives(lab), len(lab.seeds())
    names = {field.name for field in fields(Settings)}
    assert {"curves", "seed_spacing", "support_level", "passes"} <= told.keys() <= names
    halved = len(lab.seeds(seed_spacing=float(told["seed_spacing"].split(":")[0])))
    times = float(told["seed_spacing"].split()[1])
    # The support has a rim of whole cells, which is thinner for smaller ones.
    assert 0.5 * times < halved / count < 1.2 * times


def test_pairs_are_those_that_the_kernels_draw():
    """Counted pixel by pixel: where one Gaussian's image is not zero."""
    of, settings, device = problem(size=24, polychromatic=True), Settings(), torch.device("cpu")
    chosen, seeds, facts = seeded(of, ball(of, 1))
    scene = scene_of(of, chosen, settings, device)
    middle = seeds.select(seeds.position.norm(dim=1).argmin()[None])
    views = rays_of(of, chosen, settings, device).views.select([0])
    image = project_gaussians(middle, middle.attenuation[None], views, scene.kernel)[0]
    told = facts["work"][1].split()
    assert float(told[0]) == len(seeds)
    assert float(told[3]) == pytest.approx(int((image > 0).sum()), rel=0.35)


@pytest.mark.parametrize("planar", [True, False])
def test_few_voxels_get_more_seeds_than_voxels(planar):
    for pixel, spacing in ((0.1, 6 / 12), (0.5, 0.65), (1.0, 1.3)):
        of = problem(6, planar=planar, pixel=pixel)
        chosen = plan(of, ball(of, 1))
        assert chosen.spacing == pytest.approx(spacing) == plan(of, ball(of, 1), "cuda").spacing
        assert ("few voxels" in why(chosen, "seed_spacing")) == (pixel < 1)


def test_seeds_of_one_curve_have_no_material_of_their_own():
    of = problem(polychromatic=True)
    start = ball(of, 1)
    start[5:7, 5:7, 5:7] *= 8
    for curves, free in ((1, False), (3, True)):
        _, seeds, _ = seeded(of, start, curves=curves)
        assert bool((seeds.group != 0).any()) == free == (len(seeds.shared_material) > 1)
        assert not seeds.own_material.any() or free

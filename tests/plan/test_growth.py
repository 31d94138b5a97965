"""Which objects have more detail than their seeds show, told by what is left of the rays."""

import math
import sys
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from planned import planned, problem

from tomo_polysplat.fit.fitter import Batches, Fitter
from tomo_polysplat.fit.rays import batches_around
from tomo_polysplat.fit.stopping import Clock
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decisions import growth
from tomo_polysplat.plan.decisions.growth import Growth, left_over
from tomo_polysplat.plan.decisions.tv_factor import TvFactor
from tomo_polysplat.plan.lab import Untold
from tomo_polysplat.plan.order import answer_to
from tomo_polysplat.settings import Settings

sys.path.append(str(Path(__file__).parents[1] / "kernels"))
from step_scenes import fit_problem

PHOTONS = 3e4
# Nothing is so dense.
DENSE = 1e3


def scan(more=0.0, photons=PHOTONS, seed=4):
    """Gaussians, and rays of theirs with noise and as much ``more`` as a share of what they vary by."""
    gaussians, _, rays, scene, _ = fit_problem("cone", False, "cpu", "numba")
    with torch.no_grad():
        seen = scene.projections(gaussians, rays.views)[0]
    through = seen > 0.15 * seen.max()
    rng = np.random.default_rng(seed)
    noise = torch.from_numpy(rng.normal(size=seen.shape)).float() * (seen.exp() / photons).sqrt()
    other = torch.from_numpy(rng.normal(size=seen.shape)).float() * math.sqrt(more) * seen[through].std()
    return (
        gaussians,
        scene,
        replace(rays, projections=seen + noise + other, photons=photons, held_out=0.0),
        DENSE,
    )


@pytest.mark.parametrize("more", [0.03, 0.1])
def test_what_is_left_is_a_share_of_what_the_rays_vary_by(more):
    # A few hundred rays tell it to a sixth. They vary by what is added, too.
    found = np.mean([left_over(*scan(more, seed=seed)).unexplained for seed in range(12)])
    assert found == pytest.approx(more / (1 + more), rel=0.15)


def test_noise_is_no_detail():
    assert left_over(*scan()).unexplained < 0.01
    gaussians, scene, rays, _ = scan()
    assert left_over(gaussians, scene, replace(rays, photons=math.inf), DENSE).unexplained > 0


def test_rays_through_dense_matter_do_not_count():
    gaussians, scene, rays, _ = scan()
    one = gaussians.copy()
    one.attenuation[:6] += 20.0
    level = float(gaussians.attenuation.max()) + 1.0
    views, measured, weight, _ = next(iter(batches_around(rays)))
    lit = scene.projections(one.select(torch.arange(6)), views)[0] < 1e-3
    assert 0 < int(lit.sum()) < lit.numel()
    # Only the rays through what is too dense tell that it is.
    assert left_over(one, scene, rays, DENSE).unexplained > 1.0
    assert left_over(one, scene, rays, level).unexplained < 0.03
    everything = gaussians.copy()
    everything.attenuation += level
    assert left_over(everything, scene, rays, level).unexplained == 0.0


def test_where_most_rays_pass_dense_matter_the_rest_does_not_tell():
    gaussians, scene, rays, _ = scan()
    assert left_over(gaussians, scene, rays, DENSE).shaded == 0.0
    short = dimmer(gaussians)
    assert answer_to(Growth(), Bench(short, gaussians, curves=3)).value == 4.0
    # Half of the Gaussians are metal, and lie in the way of nearly all rays.
    short.attenuation[::2] += DENSE
    assert left_over(short, scene, rays, DENSE).shaded > 0.75
    answer = answer_to(Growth(), Bench(short, gaussians, curves=3))
    assert answer.value == 1.0 and "pass dense matter" in answer.why


def test_a_single_ray_beside_dense_matter_varies_by_nothing():
    # torch warns of the variance of one value.
    gaussians, scene, rays, _ = scan()
    with torch.no_grad():
        seen = scene.projections(gaussians, rays.views)[0]
    alone = torch.where(seen == seen.max(), rays.projections, torch.nan)
    assert int(torch.isfinite(alone).sum()) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert left_over(gaussians, scene, replace(rays, projections=alone), DENSE).unexplained == 0.0


class Bench:
    """A lab whose short fits come to what they are told: of the seeds, and of closer ones."""

    def __init__(self, tried, closer=None, curves=1, status=Status.ASKED, **settings):
        seeds, self.scene, self.rays, _ = scan()
        self.tried, self.closer, self.problem, self.device = tried, closer, problem(40, views=44), None
        self.settings = self.seeding = Settings(**({"bone_level": DENSE} | settings))
        self.seeds = lambda **assumed: seeds
        self.plan = planned(
            edges="blurred",
            closer_seeds=0.0,
            curves=curves,
            passes=15.0,
            seed_spacing=1.3,
            agent={},
            views_per_step=4,
        )
        self.plan.answers["edges"] = Answer("blurred", "", status)

    def trial(self, settings, rays=None, **assumed):
        chosen = self.closer if "seed_spacing" in assumed else self.tried
        if chosen is None:
            raise Untold("no time")
        return SimpleNamespace(gaussians=chosen)


@pytest.fixture(autouse=True)
def room(monkeypatch):
    """Memory for ever so many Gaussians; a test may say how many times as many."""

    def times(many):
        monkeypatch.setattr(growth, "room_to_grow", lambda *_: many)

    times(math.inf)
    return times


def dimmer(gaussians):
    """Twenty times as many that leave a third of the rays."""
    other = gaussians.select(torch.arange(len(gaussians)).repeat(20))
    other.attenuation *= 2 / 3 / 20
    return other


@pytest.mark.parametrize(
    "detail, changed, curves, times, because",
    [
        (True, {}, 1, 4.0, "closer seeds 0."),
        (False, {}, 1, 1.0, "is the geometry right"),
        (True, {}, 3, 4.0, "closer seeds 0."),
        (True, {"bone_level": 1e-3}, 1, 1.0, "dense matter whose material is not free"),
        (True, {"growth": 2.0}, 3, 2.0, "asked for"),
        (True, {"growth": 0.5}, 1, 1.0, "asked for"),
        (True, {"max_gaussians": 1}, 1, 1.0, "not asked for"),
    ],
)
def test_a_cloud_grows_where_more_gaussians_show_more(detail, changed, curves, times, because):
    gaussians = scan()[0]
    short = dimmer(gaussians)
    answer = answer_to(Growth(), Bench(short, gaussians if detail else short, curves, **changed))
    assert answer.value == times and because in answer.why


def test_a_cloud_that_is_dense_all_through_does_not_grow():
    one = Bench(dimmer(scan()[0]), scan()[0], 3)
    one.seeds().group[:] = 1
    answer = answer_to(Growth(), one)
    assert answer.value == 1.0 and "all of it is dense" in answer.why


def test_what_is_explained_asks_no_more():
    answer = answer_to(Growth(), Bench(scan()[0], None))
    assert answer.value == 1.0 and answer.status is Status.ASKED


def test_no_time_to_see_whether_more_would_help_leaves_as_many():
    answer = answer_to(Growth(), Bench(dimmer(scan()[0]), None))
    assert answer.value == 1.0 and "no time" in answer.why


def test_memory_and_a_number_that_was_asked_for_bound_it(room):
    gaussians = scan()[0]
    short = dimmer(gaussians)
    assert answer_to(Growth(), Bench(short, gaussians, max_gaussians=2 * len(gaussians))).value == 2.0
    room(3.0)
    assert answer_to(Growth(), Bench(short, gaussians)).value == 3.0
    room(1.5)
    answer = answer_to(Growth(), Bench(short, gaussians))
    assert answer.value == 1.0 and "memory for 1.5 times" in answer.why
    answer = answer_to(Growth(), Bench(short, gaussians, status=Status.USUAL))
    assert answer.value == 1.0 and "no short fit" in answer.why


def test_what_is_left_by_many_is_detail_sooner():
    # Plain surfaces leave less of the rays the more voxels, and so Gaussians, there are.
    gaussians, scene, rays, _ = scan()
    one = gaussians.copy()
    one.attenuation *= 0.8
    several = one.select(torch.arange(len(one)).repeat(40))
    several.attenuation /= 40
    assert left_over(several, scene, rays, DENSE).unexplained == pytest.approx(
        left_over(one, scene, rays, DENSE).unexplained, rel=1e-3
    )
    for short, times in ((one, 1.0), (several, 4.0)):
        assert answer_to(Growth(), Bench(short, gaussians)).value == times


@pytest.mark.parametrize(
    "times, curves, asked, factor",
    [(4.0, 1, None, 0.4), (4.0, 3, None, 1.0), (1.0, 1, None, 1.0), (4.0, 1, 0.5, 0.5)],
)
def test_a_cloud_without_dense_matter_that_grows_is_smoothed_less(times, curves, asked, factor):
    one = Bench(None, None, curves, tv_factor=asked)
    one.plan.answers |= planned(growth=times, optical_depth=2.0).answers
    answer = answer_to(TvFactor(), one)
    assert answer.value == pytest.approx(factor)
    assert ("grows" in answer.why) == (factor == 0.4)


@pytest.mark.parametrize(
    "device, kernel", [("cpu", "numba"), pytest.param("cuda", "triton", marks=pytest.mark.gpu)]
)
def test_the_optimiser_remembers_those_that_are_not_split(device, kernel):
    setup = fit_problem("cone", True, device, kernel)
    growing = replace(setup.settings, growth=2.0, relocate_until=1.0, bone_level=DENSE)
    fitter = Fitter(setup._replace(settings=growing), Batches(1, 100, np.random.default_rng(1)))
    gaussians = setup.gaussians
    count, clock = len(gaussians), Clock(100, None)
    light = int((gaussians.group <= 0).sum())
    assert 1 < light < count and fitter.most == count + light
    while len(fitter.gaussians) == count:
        before = {name: first.clone() for name, (first, _) in fitter.step.moments.items()}
        done = fitter.step.done
        where = fitter.gaussians.position.clone()
        if clock.share() >= 0.14:
            fitter._grow()
        else:
            fitter.ahead(clock, 1)
    halved = math.ceil(0.5 * light)
    assert len(fitter.gaussians) == count + halved and fitter.step.done == done
    same = (fitter.gaussians.position[:, None] == where[None]).all(dim=2).nonzero()
    assert len(same) == count - halved
    new, old = same.T
    for name, (first, _) in fitter.step.moments.items():
        if len(first) == len(fitter.gaussians):
            assert torch.equal(first[new], before[name][old])
            split = torch.ones(len(first), dtype=torch.bool, device=device)
            split[new] = False
            assert not first[split].any()
    fitter.ahead(clock, 1)
    assert fitter.gaussians.finite() and fitter.step.done > done

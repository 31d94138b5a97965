"""Which objects have more detail than their seeds show, told by what is left of the rays."""

import math
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.detail import Tried, choose_growth, smooth_less, unexplained
from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.plan import Plan
from tomo_polysplat.fit.rays import batches_around
from tomo_polysplat.fit.stopping import Clock
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
    found = np.mean([unexplained(*scan(more, seed=seed)) for seed in range(12)])
    assert found == pytest.approx(more / (1 + more), rel=0.15)


def test_noise_is_no_detail():
    assert unexplained(*scan()) < 0.01
    gaussians, scene, rays, _ = scan()
    assert unexplained(gaussians, scene, replace(rays, photons=math.inf), DENSE) > 0


def test_rays_through_dense_matter_do_not_count():
    gaussians, scene, rays, _ = scan()
    one = gaussians.copy()
    one.attenuation[:6] += 20.0
    level = float(gaussians.attenuation.max()) + 1.0
    views, measured, weight, _ = next(iter(batches_around(rays)))
    lit = scene.projections(one.select(torch.arange(6)), views)[0] < 1e-3
    assert 0 < int(lit.sum()) < lit.numel()
    # Only the rays through what is too dense tell that it is.
    assert unexplained(one, scene, rays, DENSE) > 1.0
    assert unexplained(one, scene, rays, level) < 0.03
    everything = gaussians.copy()
    everything.attenuation += level
    assert unexplained(everything, scene, rays, level) == 0.0


def plan(curves=1):
    amounts = {name: 1.0 for name in ("reference", "first", "depth", "spacing", "smallest_scale", "passes")}
    none = {name: 0.0 for name in ("soft_u", "support_level", "finer")}
    return Plan(
        **amounts, **none, views_per_step=1, tv_every=1, tv_corners=(0.1, 0.1), curves=curves, blurred=False
    )


def tried(gaussians, closer=lambda factor: None):
    return Tried(gaussians, closer)


def dimmer(gaussians):
    """Twenty times as many that leave a third of the rays."""
    other = gaussians.select(torch.arange(len(gaussians)).repeat(20))
    other.attenuation *= 2 / 3 / 20
    return other


@pytest.mark.parametrize(
    "detail, changed, curves, growth, because",
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
def test_a_cloud_grows_where_more_gaussians_show_more(detail, changed, curves, growth, because):
    gaussians, scene, rays, _ = scan()
    short = dimmer(gaussians)
    shown = tried(short, lambda factor: gaussians if detail else short)
    chosen, settings = plan(curves), Settings(**{"bone_level": DENSE} | changed)
    choose_growth(gaussians, shown, chosen, scene, rays, settings)
    assert chosen.growth == growth and because in chosen.reasons["growth"]


def test_a_cloud_that_is_dense_all_through_does_not_grow():
    gaussians, scene, rays, _ = scan()
    gaussians.group[:] = 1
    chosen = plan(3)
    shown = tried(dimmer(gaussians), lambda factor: gaussians)
    choose_growth(gaussians, shown, chosen, scene, rays, Settings(bone_level=DENSE))
    assert chosen.growth == 1.0 and "all of it is dense" in chosen.reasons["growth"]


def test_what_is_explained_asks_no_more():
    gaussians, scene, rays, _ = scan()

    def nobody(factor):
        raise AssertionError("a short fit for nothing")

    chosen = plan()
    choose_growth(gaussians, tried(gaussians, nobody), chosen, scene, rays, Settings(bone_level=DENSE))
    assert chosen.growth == 1.0 and "unexplained" in chosen.reasons["growth"]
    choose_growth(gaussians, tried(dimmer(gaussians)), chosen, scene, rays, Settings(bone_level=DENSE))
    assert chosen.growth == 1.0 and "no time" in chosen.reasons["growth"]


def test_gaussians_and_memory_limit_it():
    gaussians, scene, rays, _ = scan()
    shown = tried(dimmer(gaussians), lambda factor: gaussians)
    chosen, settings = plan(), Settings(bone_level=DENSE, max_gaussians=2 * len(gaussians))
    choose_growth(gaussians, shown, chosen, scene, rays, settings)
    assert chosen.growth == 2.0
    choose_growth(gaussians, replace(shown, room=3.0), chosen, scene, rays, Settings(bone_level=DENSE))
    assert chosen.growth == 3.0

    def nobody(factor):
        raise AssertionError("a short fit that there is no memory for")

    choose_growth(gaussians, Tried(dimmer(gaussians), nobody, 1.5), chosen, scene, rays, settings)
    assert chosen.growth == 1.0 and "memory for 1.5 times" in chosen.reasons["growth"]
    choose_growth(gaussians, None, chosen, scene, rays, settings)
    assert chosen.growth == 1.0 and "no short fit" in chosen.reasons["growth"]


def test_what_is_left_by_many_is_detail_sooner():
    # Plain surfaces leave less of the rays the more voxels, and so Gaussians, there are.
    gaussians, scene, rays, _ = scan()
    one = gaussians.copy()
    one.attenuation *= 0.8
    several = one.select(torch.arange(len(one)).repeat(40))
    several.attenuation /= 40
    assert unexplained(several, scene, rays, DENSE) == pytest.approx(
        unexplained(one, scene, rays, DENSE), rel=1e-3
    )
    for short, growth in ((one, 1.0), (several, 4.0)):
        chosen, settings = plan(), Settings(bone_level=DENSE)
        choose_growth(gaussians, tried(short, lambda factor: gaussians), chosen, scene, rays, settings)
        assert chosen.growth == growth


@pytest.mark.parametrize(
    "growth, curves, asked, factor",
    [(4.0, 1, 0.0, 0.2), (4.0, 3, 0.0, 0.5), (1.0, 1, 0.0, 0.5), (4.0, 1, 0.5, 0.5)],
)
def test_a_cloud_without_dense_matter_that_grows_is_smoothed_less(growth, curves, asked, factor):
    chosen = plan(curves)
    chosen.growth, chosen.tv_factor, chosen.reasons["smoothing"] = growth, 0.5, "half"
    smooth_less(chosen, Settings(tv_factor=asked))
    assert chosen.tv_factor == pytest.approx(factor)
    assert ("grows" in chosen.reasons["smoothing"]) == (factor == 0.2)


@pytest.mark.parametrize(
    "device, kernel", [("cpu", "numba"), pytest.param("cuda", "triton", marks=pytest.mark.gpu)]
)
def test_the_optimiser_remembers_those_that_are_not_split(device, kernel):
    gaussians, spacing, rays, scene, settings = fit_problem("cone", True, device, kernel)
    growing = replace(settings, growth=2.0, relocate_until=1.0, bone_level=DENSE)
    fitter = Fitter(gaussians, spacing, rays, scene, growing, 1, 100, np.random.default_rng(1))
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

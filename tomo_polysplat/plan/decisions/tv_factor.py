"""How strongly a volume is smoothed.

The misfit is counted in -log(I/I0) and the total variation in soft references, so what one weighs against the other
depends on how much light the object takes away: through a sample of a few millimetres a ray loses a tenth of it, and
what is a small residual there is a large share of the object. The usual weight, chosen on objects that take away half,
would melt a scaffold together.

How much smoothing is right depends on noise, views and detail together, and photon noise alone does not tell a brain,
which gains by more, from a laminate, which loses. So rays that are held out of short fits are asked: of thin objects,
which may be all smooth, how much less than the usual weight is better, and of slices of few rays a voxel, which can fit
noise and the streaks of missing views as well as the object, whether more is.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import torch

from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays, batches_around
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, When
from tomo_polysplat.plan.decisions.agent import Agent
from tomo_polysplat.plan.decisions.closer_seeds import CloserSeeds
from tomo_polysplat.plan.decisions.curves import Curves
from tomo_polysplat.plan.decisions.edges import Edges
from tomo_polysplat.plan.decisions.growth import Growth
from tomo_polysplat.plan.decisions.optical_depth import OpticalDepth
from tomo_polysplat.plan.decisions.passes import Passes
from tomo_polysplat.plan.depth import weights_by_depth
from tomo_polysplat.plan.lab import Lab, Untold
from tomo_polysplat.plan.trial import views_of_short_steps
from tomo_polysplat.settings import Settings

__all__ = ["TvFactor"]

logger = logging.getLogger(__name__)

# In thin objects the root of their factor is taken where it leaves less of the held-out misfit than the usual weight.
# What is far less is taken where it leaves less than this of what is left by then: too early to be sure of a little.
_CLEARLY = 0.97
# In slices this multiple of the usual weight is tried. It is taken where it leaves less of the held-out misfit. Eight
# slices that gain 0.4 to 3.9 dB by it came to 0.79 to 0.92, one that loses 0.6 to 0.88, a laminate that loses 2.4 to
# 1.09 (docs/decisions/tv_factor.md). Of 24 to 36 views 18 slices gain, by 0.1 to 4.7 dB, and come to 0.67 to 0.98.
_TIMES = 3.0
# A cloud that grows takes this share of the weight of smoothing: broccoli of 30^3, 34^3, 36^3 and 44^3 voxels, grown
# fourfold, gains -0.5, -0.3, 0.7 and 1.7 dB with all of it, 0.6, 0.4, 1.3 and 2.2 with 0.3 of it; in twice the room it
# makes no difference, and grains and a sponge of 40^3 have 1.8 and 1.3 dB more with 0.4. Beside metal broccoli of 64^3
# to 128^3 has 0.1 to 0.7 dB more with all of it, of 36^3 to 52^3 0.1 to 0.2 less.
_GROWN = 0.4
# Of a short fit: the longer it is, the less it shows of what smoothing holds back. In a volume fewer of many views do.
# Of a slice it sees so many views at least, in three times the passes at most: 30 views of nickel and steel came to
# 1.03 in 3 passes and to 0.92 in 6, and gain 2.5 dB.
_PASSES, _STEPS, _VIEWS_SEEN = 3.0, 100, 180
# With more rays a voxel a slice's short fits are too early to tell: slices of 3.9, which lose 1.3 dB, would have it.
_MOST_RAYS = 3.0
# Share of the rays that is held out to ask them, in so many views: as few as a run holds out tell their own noise.
_HELD_OUT, _FEWEST_HELD_OUT, _VIEWS, _VIEWS_PLANAR = 0.1, 100, 48, 1000
# A run of fewer passes, as of the fast preset, is in a hurry.
_FEWEST_PASSES = 10.0


class TvFactor(Decision):
    """How strongly is the volume smoothed?

    In times the usual weight of the total variation.
    """

    name = "tv_factor"
    needs = (Agent, CloserSeeds, Curves, Edges, Growth, OpticalDepth, Passes)
    when = When.TRIAL

    def usual(self, known: Known, lab: Lab) -> float:
        """By how thin the object is."""
        return weights_by_depth(known[OpticalDepth], lab.rays)[0] * _of_growth(known)

    def why_not(self, known: Known, lab: Lab) -> str:
        """Why no short fits are made, if so."""
        thin = weights_by_depth(known[OpticalDepth], lab.rays)[0] < 1
        seeds = len(lab.seeds())
        why = _why_not(seeds, known[Passes], lab.problem, lab.settings)
        why = why or ("" if thin else _why_no_more(lab.problem))
        return f"{_describe_usual(known, lab)}: {why}" if why else ""

    def ask(self, known: Known, lab: Lab) -> Answer:
        """What leaves less of the misfit of the rays held out of short fits."""
        by_depth, by_noise = weights_by_depth(known[OpticalDepth], lab.rays)
        asking = replace(lab.rays, held_out=max(lab.rays.held_out, _HELD_OUT))
        told = _Tries(lambda factor: _left_by(factor, asking, known, lab))
        try:
            less = [(math.sqrt(by_depth), 1.0), (by_depth, _CLEARLY), (by_noise, _CLEARLY)]
            factor = told.choose(less if by_depth < 1 else [], not _why_no_more(lab.problem))
        except Untold as reason:
            raise Untold(f"{_describe_usual(known, lab)}: {reason}") from None
        weight = "the usual weight" if factor == 1 else f"{factor:.2g} times the usual weight"
        why = f"{weight}: after a short fit {told.words()} of the misfit of the held-out rays"
        logger.info("The volume is smoothed with %s", why)
        grown = _of_growth(known)
        why += f"; of that {grown:g}, as the cloud grows to show detail" if grown < 1 else ""
        return Answer(factor * grown, why, Status.ASKED, told.evidence())

    def alternative(self, lab: Lab) -> str:
        """Saying it saves the short fits."""
        return (
            "1: without the short fits that tell how strongly thin objects and slices are smoothed; tv_weight 0:"
            " nothing is smoothed, which on a CPU takes about half of the time"
        )


def _of_growth(known: Known) -> float:
    """Share of the weight that a cloud without dense matter takes where it grows."""
    return _GROWN if known[Growth] > 1 and known[Curves] == 1 else 1.0


def _describe_usual(known: Known, lab: Lab) -> str:
    by_depth = weights_by_depth(known[OpticalDepth], lab.rays)[0]
    words, grown = "the usual weight", _of_growth(known)
    if by_depth < 1:
        light = f"{1 - math.exp(-known[OpticalDepth]):.0%} of the light"
        words = f"{by_depth:.2g} times {words}, as soft matter takes away {light} of a typical ray"
    return words + (f", and of that {grown:g}, as the cloud grows to show detail" if grown < 1 else "")


def _left_by(factor: float, asking: Rays, known: Known, lab: Lab) -> float:
    """Misfit of the held-out rays that a short fit leaves, with the usual weight multiplied by ``factor``."""
    passes, views, problem = _PASSES, lab.problem.geometry.views, lab.problem
    if problem.planar:
        passes = min(max(passes, _VIEWS_SEEN / views), 3 * passes)
    else:
        passes = min(passes, _STEPS * views_of_short_steps(lab.plan, problem) / views)
    own = lab.plan.assuming(tv_factor=factor)
    short = replace(own.adapted(lab.seeding), passes=passes, soft_gain=0.0)
    gaussians = lab.trial(short, asking).gaussians
    most = _VIEWS_PLANAR if problem.planar else _VIEWS
    uneven = bool(problem.taken.gains.any())
    return _misfit_aside(gaussians, lab.scene, asking, short, most, uneven)


@dataclass
class _Tries:
    """Factors that were tried, and what each left of the misfit."""

    left_by: Callable[[float], float]
    left: dict[float, float] = field(default_factory=dict)

    def choose(self, less: list[tuple[float, float]], more: bool) -> float:
        """The factor to take, of 1, those ever ``less`` with shares that they must leave, and with ``more`` three."""
        usual = best = self.left_by(1.0)
        if not usual:
            raise Untold("no ray of those held out is usable")
        chosen = 1.0
        for factor, share in less:
            left = self._ask(factor, usual)
            if left >= share * best:
                break
            chosen, best = factor, left
        if more and chosen == 1 and self._ask(_TIMES, usual) < usual:
            chosen = _TIMES
        return chosen

    def _ask(self, factor: float, usual: float) -> float:
        left = self.left_by(factor)
        self.left[factor] = left / usual
        return left

    def words(self) -> str:
        """What each left of the misfit of the usual weight."""
        return " and ".join(
            f"{factor:.2g} times as much leaves {left:.2f}" for factor, left in self.left.items()
        )

    def evidence(self) -> dict[str, float]:
        """The same as numbers."""
        return {f"left by {factor:.2g}": left for factor, left in self.left.items()}


@torch.no_grad()
def _misfit_aside(
    gaussians: Gaussians, scene: FitScene, rays: Rays, settings: Settings, most: int, uneven: bool
) -> float:
    """Mean misfit of the rays held out in so many views at most; 0 if there are none.

    Of ``uneven`` pixels, whose gains are not all taken out, less what those of a pixel have in common: held-out rays
    have the gains of the others, so rings, which smoothing takes away, would explain them.
    """
    common = _common_of_pixels(gaussians, scene, rays, most) if uneven else 0.0
    total = weighed = 0.0
    for views, measured, _, aside in batches_around(rays, most):
        predicted = scene.projections(gaussians, views)[0] - common
        weight = float(aside.sum())
        total += weight * float(misfit(predicted, measured, aside, settings))
        weighed += weight
    return total / weighed if weighed else 0.0


def _common_of_pixels(gaussians: Gaussians, scene: FitScene, rays: Rays, most: int) -> torch.Tensor:
    """(rows, columns) weighted mean of what the held-out rays of each pixel are missed by; 0 where it has none."""
    sums, weights = (gaussians.attenuation.new_zeros(rays.projections.shape[1:]) for _ in range(2))
    for views, measured, _, aside in batches_around(rays, most):
        missed = torch.where(aside > 0, scene.projections(gaussians, views)[0] - measured, 0.0)
        sums += (aside * missed).sum(dim=0)
        weights += aside.sum(dim=0)
    return sums / weights.clamp(min=1e-12)


def _why_not(seeds: int, passes: float, problem: Problem, settings: Settings) -> str:
    """Why no short fits are made, if so."""
    if not (seeds and settings.tv_weight):
        return "there is nothing to smooth"
    if passes < _FEWEST_PASSES:
        return "in so few passes short fits would take too long a part"
    if not settings.held_out:
        return "no rays are held out"
    if _HELD_OUT * problem.projections.size < _FEWEST_HELD_OUT:
        return f"fewer than {_FEWEST_HELD_OUT / _HELD_OUT:.0f} rays do not tell"
    return ""


def _why_no_more(problem: Problem) -> str:
    """Why more than the usual smoothing is not tried, if so."""
    if not problem.planar:
        return "more is tried in slices only"
    if problem.projections.size > _MOST_RAYS * math.prod(problem.grid.shape):
        return f"more than {_MOST_RAYS:g} rays a voxel need no more"
    return ""

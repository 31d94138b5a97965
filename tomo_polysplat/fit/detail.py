"""Whether an object has more detail than its seeds can show, told by what a short fit leaves unexplained.

Seeds as close as voxels and detector pixels allow do for walls and lumps. Of an object that is surfaces all through, as
broccoli, rays vary by much that those cannot give back. More of them at once would not lie where they are wanted;
Gaussians that are split where the rays pull at them do.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import torch

from tomo_polysplat.fit.plan import Plan
from tomo_polysplat.fit.rays import Rays, batches_around
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.density_control import splittable
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["Tried", "choose_growth", "smooth_less", "unexplained", "why_not_asked"]

logger = logging.getLogger(__name__)

# A cloud grows where a short fit of n Gaussians leaves more than this over sqrt(n) of the variance of the rays
# unexplained. What plain surfaces leave falls with the voxels across, or with n, in about that way: of a pepper of
# 26^3 to 128^3 voxels, 3e3 to 1e6 photons and 40 to 180 views it came to 0.8 to 2.15, of foam, pebbles, inclusions in
# plastic and a few spheres to 0.8 to 2.3, of a sponge and of beads (32^3 to 64^3) to 1.9 to 5.5, of broccoli and
# packed grains (30^3 to 128^3) to 5.5 to 11. Grown fourfold broccoli gains 0.5 to 3.0 dB, beads 1.4 to 1.8, grains and
# a sponge 0.8; small peppers lose 0.8 to 2.0, few spheres and inclusions up to 2.4, large peppers gain up to 1.
# With dense matter, whose rays do not count but which leaves something of its own on the others, broccoli of 36^3 to
# 128^3 voxels with iron or titanium in it came to 7.5 to 15, and gains 0.4 to 2.9 dB without metal; peppers, pancreas,
# teeth, pins and lungs to 0.6 to 3.0, and lose 0.2 to 4 dB or gain 0.3 at most.
_UNEXPLAINED, _BESIDE_DENSE = 2.35, 4.5
# And where seeds so many times as far apart leave less than this share of it. What is unexplained because the geometry
# is wrong stays so: peppers and broccoli of 36^3 to 96^3 whose axis is off by 0.25 to 1 pixel, or whose views are by
# 0.7 at random, came to 0.85 (which loses nothing) and 0.90 to 1.14, broccoli that is right to 0.61 to 0.85, beads,
# sponges and grains to 0.50 to 0.76. Growth would cost the former up to 2.4 dB.
_CLOSER, _DETAIL = 0.8, 0.88
# So many times as many Gaussians as seeds.
_GROWTH = 4.0
# Less growth is none, and closer seeds, (1/0.8)^3 times as many, need memory for so many.
_LEAST, _ROOM = 1.2, 2.5
# A cloud that grows takes this share of the weight of smoothing: broccoli of 30^3, 34^3, 36^3 and 44^3 voxels, grown
# fourfold, gains -0.5, -0.3, 0.7 and 1.7 dB with all of it, 0.6, 0.4, 1.3 and 2.2 with 0.3 of it; in twice the room it
# makes no difference, and grains and a sponge of 40^3 have 1.8 and 1.3 dB more with 0.4. Beside metal broccoli of 64^3
# to 128^3 has 0.1 to 0.7 dB more with all of it, of 36^3 to 52^3 0.1 to 0.2 less.
_SMOOTHED = 0.4
# Rays through the object see this share of what the densest one sees.
_SEEN = 0.15
# -log(I/I0) of dense matter from which on a ray does not count.
_SHADE = 1e-3
# Median of the square of a normally distributed number of variance 1.
_MEDIAN_SQUARE = 0.4549


@dataclass(frozen=True)
class Tried:
    """What seeds came to in a short fit.

    Attributes
    ----------
    gaussians : Gaussians
    closer : callable
        What seeds of their kind that are so many times as far apart come to; None where there is no time for them.
    room : float
        How many times as many Gaussians there is memory for.
    """

    gaussians: Gaussians
    closer: Callable[[float], Gaussians | None]
    room: float = math.inf


def choose_growth(
    seeds: Gaussians, tried: Tried | None, plan: Plan, scene: FitScene, rays: Rays, settings: Settings
) -> None:
    """Set the plan's ``growth`` and say why.

    Parameters
    ----------
    seeds : Gaussians
        Of the fit to come.
    tried : Tried or None
        The short fit of seeds of their kind, if there was one.
    plan : Plan
        Changed in place.
    scene, rays : FitScene, Rays
    settings : Settings
        Of the fit to come.
    """
    if settings.growth:
        plan.growth, why = max(settings.growth, 1.0), "asked for"
    else:
        plan.growth, why = _asked(seeds, tried, plan, scene, rays, settings)
    kind = (
        f"up to {plan.growth:.2g} times as many Gaussians as seeds" if plan.growth > 1 else "as many as seeds"
    )
    plan.reasons["growth"] = f"{kind}: {why}"


def smooth_less(plan: Plan, settings: Settings) -> None:
    """Take less of the smoothing that was chosen (`fit.smoothing`) where a cloud without dense matter grows; say so."""
    if plan.growth > 1 and plan.curves == 1 and not settings.tv_factor:
        plan.tv_factor *= _SMOOTHED
        plan.reasons["smoothing"] += f"; of that {_SMOOTHED:g}, as the cloud grows to show detail"


def why_not_asked(seeds: Gaussians, plan: Plan, settings: Settings) -> str:
    """Why the rays are not asked whether a cloud from these seeds should grow, if so."""
    if settings.growth:
        return "asked for"
    if plan.curves == 1 and bool((seeds.attenuation > settings.bone_level).any()):
        return "with dense matter whose material is not free it is that which a short fit leaves unexplained"
    if not bool(splittable(seeds, settings.bone_level).any()):
        return "all of it is dense"
    return "" if _most(seeds, settings) >= _LEAST else "more were not asked for"


def _most(seeds: Gaussians, settings: Settings) -> float:
    """How many times as many Gaussians there may be."""
    return min(_GROWTH, settings.max_gaussians / max(len(seeds), 1)) if settings.max_gaussians else _GROWTH


def _asked(
    seeds: Gaussians, tried: Tried | None, plan: Plan, scene: FitScene, rays: Rays, settings: Settings
) -> tuple[float, str]:
    why_not = why_not_asked(seeds, plan, settings)
    if why_not or tried is None:
        return 1.0, why_not or "no short fit told of more detail"
    if tried.room < _ROOM:
        return 1.0, f"there is memory for {tried.room:.2g} times as many"
    left = unexplained(tried.gaussians, scene, rays, settings.bone_level)
    usual = (_BESIDE_DENSE if plan.curves > 1 else _UNEXPLAINED) / math.sqrt(max(len(tried.gaussians), 1))
    why = f"a short fit leaves {left:.2%} of what the rays vary by unexplained, plain surfaces up to {usual:.2%}"
    if left <= usual:
        return 1.0, why
    closer = tried.closer(_CLOSER)
    if closer is None:
        return 1.0, f"{why}, and there was no time to see whether more Gaussians would not"
    share = unexplained(closer, scene, rays, settings.bone_level) / left
    why += f", and closer seeds {share:.2f} of that"
    logger.info("Detail: %s", why)
    if share >= _DETAIL:
        return 1.0, f"{why}, so that it is no detail; is the geometry right?"
    return min(_most(seeds, settings), tried.room), why


@torch.no_grad()
def unexplained(gaussians: Gaussians, scene: FitScene, rays: Rays, bone_level: float) -> float:
    """Mean square of what Gaussians leave of the rays through the object, less its noise, over the rays' variance.

    Rays through what is denser than ``bone_level`` do not count: it leaves something of its own. The median stands for
    the mean, which a few rays past edges would decide.
    """
    dense, light = (
        gaussians.select(which.nonzero()[:, 0])
        for which in (gaussians.attenuation > bone_level, gaussians.attenuation <= bone_level)
    )
    if not len(light):
        return 0.0
    squares, noise, seen = [], [], []
    for views, measured, weight, _ in batches_around(rays):
        predicted = soft = scene.projections(light, views)[0]
        through = (weight > 0) & (soft > _SEEN * soft.max())
        if len(dense):
            predicted = scene.projections(gaussians, views)[0]
            through &= scene.projections(dense, views)[0] < _SHADE
        squares.append((predicted - measured)[through].square())
        # The variance of -log(I/I0) is exp(P)/I0 for Poisson counts.
        noise.append(measured[through].exp() / rays.photons)
        seen.append(measured[through])
    if not any(len(values) for values in seen):
        return 0.0
    left = float(torch.cat(squares).median()) / _MEDIAN_SQUARE - float(torch.cat(noise).median())
    variance = float(torch.cat(seen).var())
    return max(left, 0.0) / variance if math.isfinite(variance) and variance > 0 else 0.0

"""Whether an object has more detail than its seeds can show, told by what a short fit leaves unexplained.

Seeds as close as voxels and detector pixels allow do for walls and lumps. Of an object that is surfaces all through, as
broccoli, rays vary by much that those cannot give back. More of them at once would not lie where they are wanted;
Gaussians that are split where the rays pull at them do.
"""

from __future__ import annotations

import logging
import math
from typing import Any, NamedTuple

import torch

from tomo_polysplat.fit.rays import Rays, batches_around
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.density_control import splittable
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, When, is_number
from tomo_polysplat.plan.decisions.agent import Agent
from tomo_polysplat.plan.decisions.closer_seeds import CloserSeeds
from tomo_polysplat.plan.decisions.curves import Curves
from tomo_polysplat.plan.decisions.edges import Edges, settings_of_trial, why_no_trial
from tomo_polysplat.plan.decisions.passes import Passes
from tomo_polysplat.plan.decisions.seed_spacing import SeedSpacing
from tomo_polysplat.plan.first_gaussians import room_to_grow
from tomo_polysplat.plan.lab import Lab, Untold
from tomo_polysplat.settings import Settings

__all__ = ["Growth", "LeftOver", "left_over"]


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
# Rays through the object see this share of what the densest one sees.
_SEEN = 0.15
# -log(I/I0) of dense matter from which on a ray does not count.
_SHADE = 1e-3
# Where more than this share of the rays do not count, the rest tells of what lies between metal, not of detail: 0.9
# in a connector with brass pins (21.5 dB in half the time; grown 20.4). Other objects come to 0.54 at most.
_MOST_SHADED = 0.75
# Median of the square of a normally distributed number of variance 1.
_MEDIAN_SQUARE = 0.4549


class LeftOver(NamedTuple):
    """What a fit leaves of the rays through lighter matter.

    Attributes
    ----------
    unexplained : float
        Mean square of what it leaves, less its noise, over the rays' variance.
    shaded : float
        Share of these rays that pass dense matter, too, and do not count.
    """

    unexplained: float
    shaded: float


class Growth(Decision):
    """Does the object have more detail than its seeds can show?

    There may be so many times as many Gaussians as seeds in the end, by splitting; 1: no more of them.
    """

    name = "growth"
    needs = (Agent, Passes, SeedSpacing, Edges, CloserSeeds, Curves)
    when = When.TRIAL

    def given(self, settings: Settings) -> Any | None:
        """At least as many as seeds."""
        return None if settings.growth is None else max(settings.growth, 1.0)

    def valid(self, value: object) -> bool:
        """No fewer than seeds."""
        return is_number(value, 1.0)

    def usual(self, known: Known, lab: Lab) -> float:
        """As many as seeds."""
        return 1.0

    def why_not(self, known: Known, lab: Lab) -> str:
        """Why the rays are not asked, if so."""
        seeds, dense = lab.seeds(edges=known[Edges]), lab.settings.bone_level
        if known[Curves] == 1 and bool((seeds.attenuation > dense).any()):
            return (
                "with dense matter whose material is not free it is that which a short fit leaves unexplained"
            )
        if not bool(splittable(seeds, dense).any()):
            return "all of it is dense"
        if most_times(len(seeds), lab.settings) < _LEAST:
            return "more were not asked for"
        status = known.answer(Edges).status
        no_trial = why_no_trial(known[SeedSpacing], known[Passes], lab)
        return "no short fit told of more detail" if no_trial or status is Status.USUAL else ""

    def ask(self, known: Known, lab: Lab) -> Answer:
        """Whether a short fit leaves more unexplained than plain surfaces do, and closer seeds less of that."""
        short, dense, kind = settings_of_trial(lab), lab.settings.bone_level, known[Edges]
        # The trial's seeds are those of the start, no closer.
        tried = lab.trial(short, edges=kind, closer_seeds=0.0).gaussians
        plan = lab.plan.assuming(edges=kind, closer_seeds=0.0)
        room = room_to_grow(len(tried), plan, lab.problem, lab.device)
        if room < _ROOM:
            raise Untold(f"there is memory for {room:.2g} times as many")
        left, shaded = left_over(tried, lab.scene, lab.rays, dense)
        if shaded > _MOST_SHADED:
            raise Untold(
                f"{shaded:.0%} of the rays through soft matter pass dense matter: the rest tells of no detail"
            )
        usual = (_BESIDE_DENSE if known[Curves] > 1 else _UNEXPLAINED) / math.sqrt(max(len(tried), 1))
        why = f"a short fit leaves {left:.2%} of what the rays vary by unexplained, plain surfaces up to {usual:.2%}"
        evidence = {"unexplained": left, "usual": usual}
        if left <= usual:
            return Answer(1.0, why, Status.ASKED, evidence)
        closer = _CLOSER * known[SeedSpacing]
        try:
            of_closer = lab.trial(short, edges=kind, closer_seeds=0.0, seed_spacing=closer).gaussians
        except Untold:
            raise Untold(f"{why}, and there was no time to see whether more Gaussians would not") from None
        share = left_over(of_closer, lab.scene, lab.rays, dense).unexplained / left
        why, evidence = f"{why}, and closer seeds {share:.2f} of that", evidence | {"closer": share}
        logger.info("Detail: %s", why)
        if share >= _DETAIL:
            return Answer(
                1.0, f"{why}, so that it is no detail; is the geometry right?", Status.ASKED, evidence
            )
        seeds = len(lab.seeds(edges=kind))
        return Answer(min(most_times(seeds, lab.settings), room), why, Status.ASKED, evidence)

    def alternative(self, lab: Lab) -> str:
        """More Gaussians, or none."""
        return (
            "4: four times the Gaussians in the end, by splitting, and half to all of the time again; 1: none"
        )


def most_times(seeds: int, settings: Settings) -> float:
    """How many times as many Gaussians there may be."""
    return min(_GROWTH, settings.max_gaussians / max(seeds, 1)) if settings.max_gaussians else _GROWTH


@torch.no_grad()
def left_over(gaussians: Gaussians, scene: FitScene, rays: Rays, bone_level: float) -> LeftOver:
    """What Gaussians leave of the rays through lighter matter.

    Rays that pass what is denser than ``bone_level`` do not count: it leaves something of its own. The median stands
    for the mean, which a few rays past edges would decide.
    """
    dense, light = (
        gaussians.select(which.nonzero()[:, 0])
        for which in (gaussians.attenuation > bone_level, gaussians.attenuation <= bone_level)
    )
    if not len(light):
        return LeftOver(0.0, 0.0)
    squares, noise, seen, shaded = [], [], [], 0
    for views, measured, weight, _ in batches_around(rays):
        predicted = soft = scene.projections(light, views)[0]
        through = (weight > 0) & (soft > _SEEN * soft.max())
        if len(dense):
            predicted = scene.projections(gaussians, views)[0]
            behind = through & (scene.projections(dense, views)[0] >= _SHADE)
            shaded += int(behind.sum())
            through &= ~behind
        squares.append((predicted - measured)[through].square())
        noise.append(rays.variance(measured[through]))
        seen.append(measured[through])
    lit = sum(len(values) for values in seen)
    share = shaded / max(shaded + lit, 1)
    if not lit:
        return LeftOver(0.0, share)
    left = float(torch.cat(squares).median()) / _MEDIAN_SQUARE - float(torch.cat(noise).median())
    variance = float(torch.cat(seen).var(correction=0))
    known = math.isfinite(variance) and variance > 0
    return LeftOver(max(left, 0.0) / variance if known else 0.0, share)

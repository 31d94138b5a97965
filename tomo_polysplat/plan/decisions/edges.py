"""Whether an object's edges are as sharp as the detector could show, told by two short fits.

Seeds that are thin across the edges of the start make sharp edges sharper than round ones do, and edges that are
blurred, as those of a breathing patient, too sharp: a fit does not undo that. Neither the start nor the detector's
resolution tells which of the two an object has; the rays do, after one pass over the views from either kind of seed.
"""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import torch

from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.rays import Rays, batches_around
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, When
from tomo_polysplat.plan.decisions.agent import Agent
from tomo_polysplat.plan.decisions.detector_blur import DetectorBlur
from tomo_polysplat.plan.decisions.passes import Passes
from tomo_polysplat.plan.decisions.seed_spacing import SeedSpacing
from tomo_polysplat.plan.lab import Lab, Untold
from tomo_polysplat.plan.resolution import finest_spacing
from tomo_polysplat.plan.trial import TOO_SHORT, views_of_short_steps
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.initial import FEW_VIEWS

__all__ = ["Edges", "settings_of_trial", "why_no_trial"]

logger = logging.getLogger(__name__)

# Thin seeds are taken where they leave less than this share of the misfit that round ones leave. 34 scans of objects
# with sharp edges (24^3 to 256^3 voxels) came to 0.69 to 0.95, those of broccoli, which gains and loses nothing, to
# 0.95 to 0.99, and 20 of blurred ones, of which many lose by thin seeds, up to 4 dB, to 0.98 and more.
_SHARP = 0.96
# A short fit is one pass over the views. It need not have more steps than the first number, but has at least as many
# views as the second: 40 views in steps of one came to 0.75 to 0.97 by the seed, and in 1.8 passes to 0.67 to 0.81.
_STEPS, _FEWEST_VIEWS = 40, 72
# Times as long where the detector spreads light and thin seeds leave no less: at first the blur that is fitted is too
# small, and round seeds stand for it. Noise of neighbouring pixels that correlates by so much tells of such a detector,
# as of 0.46 pixels: 0.52 to 0.78 in scans with 0.5 to 0.8 pixels, 0.14 at most in others.
_LONGER, _SPREAD = 2, 0.3
# Distance of the seeds, in distances that the detector could tell apart, beyond which nothing is asked. These seeds are
# thin as it is, and gain less by being thinner than the short fits cost (teeth of 96^3, 128^3 and 256^3, 1.3, 1.4 and
# 2.1 times as far: 2.0, 1.8 and 0.3 dB).
_FARTHEST = 1.8
# Fewer voxels along the longest edge show no edge so sharp that it would pay (24^3 and 28^3: -0.2 to 0.0 dB by thin
# seeds, though the rays are fitted better).
_FEWEST_VOXELS = 30
# A run of fewer passes, as of the fast preset, is in a hurry.
_FEWEST_PASSES = 6.0


class Edges(Decision):
    """Are the object's edges as sharp as the detector could show?

    "sharp": seeds are thin across edges however close they are. "blurred": they are not.
    """

    name = "edges"
    needs = (Agent, DetectorBlur, Passes, SeedSpacing)
    when = When.TRIAL

    def valid(self, value: object) -> bool:
        """One of two words."""
        return value in ("sharp", "blurred")

    def why_not(self, known: Known, lab: Lab) -> str:
        """Why no short fits are made, if so."""
        why = why_no_trial(known[SeedSpacing], known[Passes], lab)
        if not why and not len(lab.seeds(edges="blurred")):
            return "there are no seeds: the start volume is empty"
        return why

    def usual(self, known: Known, lab: Lab) -> str:
        """Seeds no thinner than the detector could tell apart."""
        return "blurred"

    def ask(self, known: Known, lab: Lab) -> Answer:
        """Two short fits say whether thin seeds leave clearly less of the misfit."""
        short = settings_of_trial(lab)
        try:
            share = _share(lab, short)
            if share >= _SHARP and known[DetectorBlur] and _spreads_light(lab):
                share = _share(lab, settings_of_trial(lab, _LONGER))
        except Untold:
            raise Untold(f"round seeds: {TOO_SHORT} how sharp edges are") from None
        sharp = share < _SHARP
        kind = "sharp, and seeds thin across them" if sharp else "not sharp enough for thin seeds"
        why = f"{kind}: after a short fit these leave {share:.2f} of the misfit that others leave"
        logger.info("Edges are %s", why)
        return Answer("sharp" if sharp else "blurred", why, Status.ASKED, {"share": share})

    def alternative(self, lab: Lab) -> str:
        """Saying it saves the short fits."""
        return (
            "sharp or blurred: without two short fits, of about a pass over the views each, that tell which"
        )


def settings_of_trial(lab: Lab, longer: float = 1.0) -> Settings:
    """Of a short fit of about a pass over the views, or of so many times as much, without smoothing."""
    views = lab.problem.geometry.views
    steps = _STEPS * views_of_short_steps(lab.plan, lab.problem)
    passes = max(_FEWEST_VIEWS, min(views, steps)) / views * longer
    return replace(lab.seeding, passes=passes, soft_gain=0.0, tv_weight=0.0)


def why_no_trial(spacing: float, passes: float, lab: Lab) -> str:
    """Why no short fits of seeds so far apart are made, if so."""
    problem, settings = lab.problem, lab.settings
    if not settings.seed_edge:
        return "round seeds: asked for"
    if settings.seed_spacing:
        return "round seeds: their distance was asked for"
    if problem.planar:
        return "round seeds: slices gain nothing by thin ones"
    if spacing > _FARTHEST * finest_spacing(problem)[0]:
        return "seeds as thin as the detector could tell apart, across edges: they are far from each other"
    if max(problem.grid.shape) < _FEWEST_VOXELS:
        return f"round seeds: fewer than {_FEWEST_VOXELS} voxels along an edge gain nothing by thin ones"
    if passes < _FEWEST_PASSES:
        return "round seeds: in so few passes two short fits would take too long a part"
    if problem.geometry.views < FEW_VIEWS:
        return f"round seeds: fewer than {FEW_VIEWS} views do not tell how sharp edges are"
    return ""


def _spreads_light(lab: Lab) -> bool:
    """Whether the detector does, rather than the object having blurred edges, as the noise tells."""
    return lab.problem.correlation_of_noise(lab.device) > _SPREAD


def _share(lab: Lab, short: Settings) -> float:
    """How much thin seeds leave of the misfit that round ones leave."""
    of_round, of_thin = (
        _misfit(lab.trial(short, edges=kind).gaussians, lab.scene, lab.rays, short)
        for kind in ("blurred", "sharp")
    )
    return of_thin / of_round if of_round else 1.0


@torch.no_grad()
def _misfit(gaussians: Gaussians, scene: FitScene, rays: Rays, settings: Settings) -> float:
    """Mean misfit of the fitted rays of some views."""
    misfits = []
    for views, measured, weight, _ in batches_around(rays):
        predicted, _ = scene.projections(gaussians, views)
        misfits.append(float(misfit(predicted, measured, weight, settings)))
    return float(np.mean(misfits))

"""Say so where the rays show no object: a scan of air, flats taken for a scan, or a wrong folder."""

from __future__ import annotations

import logging
import math

import numpy as np

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan.plan import Plan

__all__ = ["doubt_object", "rays_are_noise"]

logger = logging.getLogger(__name__)

_VIEWS = 24
# Air of 50 photons comes to 1.17, as logarithms of few are skewed, of 200 to 1.07, of 20 000 to 1.01. Matter adds more:
# what takes a tenth of the light in a hundredth of the field, at 1e4 photons, once as much as the noise.
_NOISE_ALONE = 1.2


def rays_are_noise(problem: Problem, photons: float) -> str:
    """Words on it if rays vary by no more than their noise, of so many photons an unattenuated ray; else none.

    Without noise, or behind filters of each pixel's own, it is not told.
    """
    if not math.isfinite(photons) or problem.filter_map is not None:
        return ""
    some = problem.projections[:: -(-len(problem.projections) // _VIEWS)]
    finite = np.asarray(some[np.isfinite(some)], np.float64)
    if not len(finite) or (share := float(finite.var()) * photons) > _NOISE_ALONE:
        return ""
    return f"the variance of -log(I/I0) is {share:.2f} of that of its noise, as of a scan of air"


def doubt_object(problem: Problem, plan: Plan, photons: float) -> None:
    """Warn, and note as ``plan.facts["object"]``, if the rays show no object."""
    if words := rays_are_noise(problem, photons):
        plan.note("object", "none", words)
        logger.warning(
            "The rays show no object: %s. Are they those of the scan, and not its open field?", words
        )

"""A problem whose pixels are behind a filter that is not everywhere as thick."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

from tomo_polysplat.checks import fail
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.physics.filter_map import FilterMap, require_filter_map

__all__ = ["filtered"]

logger = logging.getLogger(__name__)


def filtered(problem: Problem, filter_map: Any, unit: str, curved: bool) -> Problem:
    """The problem with the filter that a caller tells of.

    Parameters
    ----------
    problem : Problem
    filter_map : (material, thickness) or (material, thickness, density), or None
        See `reconstruct`.
    unit : str
        Of the thickness.
    curved : bool
        Whether the detector is curved, whose pixels are not the caller's any more.

    Raises
    ------
    ValueError, TypeError
        For what is no such map, or does not fit the detector.
    """
    if filter_map is None:
        return problem
    if not problem.polychromatic:
        require_filter_map(filter_map)
        logger.info(
            "One energy is dimmed by a filter and not hardened: the open beam tells, filter_map does not count."
        )
        return problem
    if curved:
        raise fail(
            "filter_map", "a flat detector beside it", "cyl_cone_vec", "resample the scan to a flat one"
        )
    rows, columns = problem.projections.shape[1:]
    return replace(problem, filter_map=FilterMap.of(filter_map, unit, rows, columns))

"""A problem whose pixels are behind a filter that is not everywhere as thick."""

from __future__ import annotations

import logging
from dataclasses import replace
from typing import Any

from tomo_polysplat.checks import fail, require_choice
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.physics.filter_map import FilterMap, require_filter_map
from tomo_polysplat.scan.scan import Scan

__all__ = ["FIT", "can_be_found", "filter_to_find", "filtered"]

logger = logging.getLogger(__name__)

# What a caller says for a filter that is to be found.
FIT = "fit"
_CURVED = "cyl_cone_vec"


def filter_to_find(scan: Any, filter_map: Any, time_budget: float | None) -> tuple[Any, Any, bool]:
    """Scan and map of a caller, both without a map where one is to be found, and whether it is.

    Raises
    ------
    ValueError
        For another word than "fit", and for fits beside a time budget, which they would not keep.
    """
    if not isinstance(filter_map, str):
        return scan, filter_map, False
    require_choice("filter_map", filter_map, (FIT,))
    if time_budget is not None:
        raise fail(
            "filter_map",
            "a map or none beside a time_budget, which its fits would not keep",
            repr(filter_map),
        )
    return (replace(scan, filter_map=None) if isinstance(scan, Scan) else scan), None, True


def can_be_found(problem: Problem, kind: str) -> bool:
    """Whether a scan of this type of geometry, as ASTRA calls it, can tell a filter.

    Raises
    ------
    ValueError
        For a curved detector, whose pixels are not the caller's any more.
    """
    if kind == _CURVED:
        raise _curved()
    if not problem.polychromatic:
        logger.info("One energy is dimmed by a filter and not hardened: filter_map='fit' does not count.")
    return problem.polychromatic


def _curved() -> Exception:
    return fail("filter_map", "a flat detector beside it", _CURVED, "resample the scan to a flat one")


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
        raise _curved()
    rows, columns = problem.projections.shape[1:]
    return replace(problem, filter_map=FilterMap.of(filter_map, unit, rows, columns))

"""Where the axis of rotation was, asked by default: of opposite rays, and of short fits where these do not tell it.

An axis that is off is moved where short fits explain the rays better with it.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.axis_by_fits import FitsByAxis, axis_by_fits, fits_that_show
from tomo_polysplat.plan.coarse import LEAST_PASSES
from tomo_polysplat.plan.fall_of_misfits import fall_of_misfits
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.scan.axis_offset import AxisOffset, offset_of
from tomo_polysplat.scan.moves import Scanner, moved_geometry
from tomo_polysplat.scan.opposite_geometry import opposite_rays_of
from tomo_polysplat.scan.opposite_rays import OppositeRays
from tomo_polysplat.scan.probes.direction import REMEDY, runs_backwards

__all__ = ["aligned", "find_axis", "is_known"]

logger = logging.getLogger(__name__)

# An axis is moved that is off by more than this, in columns, beyond so many standard errors; by so many where a time
# budget leaves no room for fits. 158 perfect scans of 10 kinds came to 3.3 at most (docs/decisions/alignment.md).
_TOLERATED, _SURE, _SURE_ALONE = 0.03, 4.0, 8.0
# An error below this is as good as none: it costs less than a tenth of a decibel.
_KNOWN = 0.05
# Fits begin where opposite rays have the axis if it is off by so many of their standard errors.
_NEAR = 2.0
# An axis known to this has opposite rays that agree: which way the angles go need not be asked, which saves its time.
_AGREED = 0.02


@dataclass(frozen=True)
class _Told:
    """Where the axis is, who tells it, the fits that were made, and how much better rays agree the other way round."""

    found: AxisOffset
    by: str
    fits: FitsByAxis | None
    turned: float = 0.0


def find_axis(problem: Problem, options: FitOptions, report: Callable[[float, str], Any]) -> Answer:
    """By how much the detector stood beside where it was told, along its columns.

    Parameters
    ----------
    problem : Problem
        As told.
    options : FitOptions
    report : callable
        Gets the share done, none, and words.

    Returns
    -------
    Answer
        Its value is ``{"u": pixels}``, or empty where the geometry stays as told: the axis is there, or the rays do
        not tell, or two fits, as told and moved, do not confirm it by rays held out of them.
    """
    report(0.0, "axis of rotation")
    told = _told(problem, options)
    found, moves = told.found, dict[str, Any]()
    evidence = {} if found.doubt else {"offset": found.columns, "error": found.error}
    needed = _SURE if options.time_budget is None else _SURE_ALONE
    words = _in_words(found)
    if not found.doubt and abs(found.columns) > _TOLERATED + needed * found.error:
        moves = {"u": found.columns}
        if options.time_budget is None:
            asked, why = _asked_of_fits(problem, found.columns, told.fits, options)
            evidence = evidence | asked if asked else {}
            if not asked or not asked["better"] > 0:
                moves, words = {}, f"{told.by} tell {_moved_by(found)}, which {why}"
    if moves:
        words = f"{_moved_by(found)}, told by {told.by}"
        logger.warning("The axis of rotation was off. Moved: %s. align=False leaves it.", words)
    else:
        logger.info("Alignment: %s", words)
    if told.turned:
        said = f"opposite rays agree {told.turned:.1f} times better with the angles turned round: {REMEDY}"
        logger.warning("%s.", said.capitalize())
        words, evidence = f"{words}; {said}", evidence | {"turned": told.turned}
    return Answer(moves, words, Status.ASKED, evidence)


def is_known(answer: Answer) -> bool:
    """Whether an answer of `find_axis` says where the axis is, moved or as told."""
    evidence = answer.evidence
    return (
        "error" in evidence
        and evidence["error"] <= _KNOWN
        and (bool(answer.value) or "better" not in evidence)
    )


def aligned(problem: Problem, moves: dict[str, Any]) -> Problem:
    """The problem by the scanner as it stood."""
    if not moves:
        return problem
    import torch

    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in moves.items()}
    return problem.seen_by(moved_geometry(Scanner(problem.geometry, problem.axis), values))


def _in_words(found: AxisOffset) -> str:
    """What is said of an axis that stays."""
    if found.doubt:
        return f"where the axis of rotation is the rays do not tell: {found.doubt}"
    if found.error > _KNOWN:
        return f"the axis of rotation is known to {found.error:.2g} px only"
    off = f"{abs(found.columns):.3f} px (standard error {found.error:.2g})"
    return f"the axis of rotation is where it was told, to {off}"


def _moved_by(found: AxisOffset) -> str:
    return f"u {found.columns:+.3f} px (standard error {found.error:.2g})"


def _told(problem: Problem, options: FitOptions) -> _Told:
    """What opposite rays tell, or short fits where these know the axis better."""
    found, rays = _told_by_rays(problem)
    turned = 0.0
    if rays is not None and (found.doubt or found.error > _AGREED):
        turned = _told_of_angles(rays, found)
    by_rays = _Told(found, "opposite rays", None, turned)
    hurried = options.time_budget is not None or (options.settings.passes or np.inf) < LEAST_PASSES
    # The wrong way round no axis explains the rays.
    if turned or hurried or found.error <= _KNOWN:
        return by_rays
    near = found.columns if not found.doubt and abs(found.columns) > _NEAR * found.error else 0.0
    try:
        by_fits, fits = axis_by_fits(problem, near, _KNOWN, options)
    except Exception as broken:
        logger.warning("A short fit failed, so it does not tell the axis of rotation: %r", broken)
        return by_rays
    if by_fits.error < found.error:
        return _Told(by_fits, "short fits", fits)
    if found.doubt and by_fits.doubt:
        found = replace(found, doubt=f"{found.doubt}; {by_fits.doubt}")
    return replace(by_rays, found=found, fits=fits)


def _told_by_rays(problem: Problem) -> tuple[AxisOffset, OppositeRays | None]:
    """What opposite rays tell, and these of a fan or a cone: nothing where that fails, for the run does not need it."""
    try:
        # Of rays that are on a device the rows that tell are fetched alone.
        rays = opposite_rays_of(cast("np.ndarray", problem.projections), problem.geometry)
        return offset_of(rays), None if problem.geometry.beam == "parallel" else rays
    except ValueError as why:
        return AxisOffset(0.0, np.inf, str(why)), None
    except Exception as error:
        logger.warning("Comparing opposite rays failed, so the axis stays as told: %r", error)
        return AxisOffset(0.0, np.inf, f"comparing them failed: {error!r}"), None


def _told_of_angles(rays: OppositeRays, told: AxisOffset) -> float:
    """How many times better opposite rays of a fan or a cone agree the other way round; 0 where they tell nothing."""
    try:
        return runs_backwards(rays, told)
    except Exception as error:
        logger.debug("Which way the angles go is not told: %r", error)
        return 0.0


def _asked_of_fits(
    problem: Problem, columns: float, fits: FitsByAxis | None, options: FitOptions
) -> tuple[dict[str, float], str]:
    """Share by which the misfit of held-out rays falls if moved, its error, and what is said where it does not."""
    try:
        fits = fits_that_show(problem, columns, options, fits)
        told, moved = (fits.misfits(place) for place in (0.0, columns))
    except Exception as broken:
        logger.warning("A short fit failed, so the axis stays as told: %r", broken)
        return {}, f"could not be asked of two short fits: {broken!r}"
    better, error = fall_of_misfits(told, moved, 0.0)
    return {"better": better, "better_error": error}, "rays held out of two short fits do not confirm"

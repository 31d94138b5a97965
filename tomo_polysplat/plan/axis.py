"""Where the axis of rotation was, asked by default: of opposite rays, then of two short fits if they say it is off."""

from __future__ import annotations

import logging
from collections.abc import Callable
from typing import Any, cast

import numpy as np

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.coarse import coarse_problem, coarse_settings
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.short_fit import short_fit
from tomo_polysplat.ranks import current_ranks
from tomo_polysplat.scan.axis_offset import AxisOffset, offset_of
from tomo_polysplat.scan.moves import Scanner, moved_geometry
from tomo_polysplat.scan.opposite_geometry import opposite_rays_of
from tomo_polysplat.scan.opposite_rays import OppositeRays
from tomo_polysplat.scan.probes.direction import REMEDY, runs_backwards

__all__ = ["aligned", "axis_of", "find_axis", "is_known"]

logger = logging.getLogger(__name__)

# An axis is moved that is off by more than this, in columns, beyond so many standard errors; by so many where a time
# budget leaves no room for fits. 158 perfect scans of 10 kinds came to 3.3 at most (docs/decisions/alignment.md).
_TOLERATED, _SURE, _SURE_ALONE = 0.03, 4.0, 8.0
# An error below this is as good as none: it costs less than a tenth of a decibel.
_KNOWN = 0.05
# An axis known to this has opposite rays that agree: which way the angles go need not be asked, which saves its time.
_AGREED = 0.02
# Columns of the two fits at least, and their steps.
_FEWEST_COLUMNS, _STEPS = 24, 60


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
    found, rays = _told_by_rays(problem)
    evidence = {} if found.doubt else {"offset": found.columns, "error": found.error}
    moves: dict[str, Any] = {}
    if rays is not None and (found.doubt or found.error > _AGREED):
        _warn_of_angles(rays, found)
    needed = _SURE if options.time_budget is None else _SURE_ALONE
    words = _in_words(found)
    if not found.doubt and abs(found.columns) > _TOLERATED + needed * found.error:
        moves = {"u": found.columns}
        if options.time_budget is None:
            misfits, why = _asked_of_fits(problem, moves, options)
            evidence = evidence | misfits if misfits else {}
            if not misfits or not misfits["moved"] < misfits["without"]:
                moves, words = {}, f"opposite rays tell {_moved_by(found)}, which {why}"
    if moves:
        words = f"{_moved_by(found)}, told by opposite rays"
        logger.warning("The axis of rotation was off. Moved: %s. align=False leaves it.", words)
    else:
        logger.info("Alignment: %s", words)
    return Answer(moves, words, Status.ASKED, evidence)


def is_known(answer: Answer) -> bool:
    """Whether an answer of `find_axis` says where the axis is, moved or as told."""
    evidence = answer.evidence
    return (
        "error" in evidence
        and evidence["error"] <= _KNOWN
        and (bool(answer.value) or "moved" not in evidence)
    )


def aligned(problem: Problem, moves: dict[str, Any]) -> Problem:
    """The problem by the scanner as it stood."""
    if not moves:
        return problem
    import torch

    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in moves.items()}
    return problem.seen_by(moved_geometry(Scanner(problem.geometry, axis_of(problem)), values))


def axis_of(problem: Problem) -> np.ndarray:
    """A point on the axis of rotation, in the solver's coordinates."""
    return -problem.centre / problem.length


def _in_words(found: AxisOffset) -> str:
    """What opposite rays say of an axis that stays."""
    if found.doubt:
        return f"where the axis of rotation is the rays do not tell: {found.doubt}"
    if found.error > _KNOWN:
        return f"the axis of rotation is known to {found.error:.2g} px only"
    off = f"{abs(found.columns):.3f} px (standard error {found.error:.2g})"
    return f"the axis of rotation is where it was told, to {off}"


def _moved_by(found: AxisOffset) -> str:
    return f"u {found.columns:+.3f} px (standard error {found.error:.2g})"


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


def _warn_of_angles(rays: OppositeRays, told: AxisOffset) -> None:
    """Say that a fan or a cone went the other way round, where opposite rays that do not tell an axis tell that."""
    try:
        better = runs_backwards(rays, told)
    except Exception as error:
        logger.debug("Which way the angles go is not told: %r", error)
        return
    if better:
        logger.warning(
            "Opposite rays agree %.1f times better with the angles turned round: %s.", better, REMEDY
        )


def _asked_of_fits(
    problem: Problem, moves: dict[str, Any], options: FitOptions
) -> tuple[dict[str, float], str]:
    """Misfit of held-out rays without the moves and moved, and what is to be said where the latter is not less.

    A fit that fails confirms nothing. Of one over several processes the others may be left behind: then the run fails.
    """
    try:
        told, moved = (_held_out(one, options) for one in (problem, aligned(problem, moves)))
    except Exception as error:
        if current_ranks().count > 1:
            raise
        logger.warning("A short fit failed, so the axis stays as told: %r", error)
        return {}, f"could not be asked of two short fits: {error!r}"
    return {"without": told, "moved": moved}, "rays held out of two short fits do not confirm"


def _held_out(problem: Problem, options: FitOptions) -> float:
    """Misfit of rays that are held out of a short fit by joined pixels."""
    factor = 1
    while problem.geometry.columns // (2 * factor) >= _FEWEST_COLUMNS:
        factor *= 2
    coarse, _ = coarse_problem(problem, factor)
    short = FitOptions(coarse_settings(options.settings), None, options.seed, options.device)
    start, _ = first_volume(coarse, options.device, short.settings)
    return short_fit(coarse, start, {}, short, fewest_steps=_STEPS).held_out

"""Where the scanner stood, and what its light did, as far as that is found before the questions of a run."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan.alignment import align
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.plan.axis import aligned, find_axis
from tomo_polysplat.plan.checkpoint import Checkpoint
from tomo_polysplat.plan.early_light import take_out_early
from tomo_polysplat.plan.first_look import first_look
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.light_told import EARLY_LIGHT
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.preparation import RunOptions, lab_of
from tomo_polysplat.plan.realignment import is_joined, realigned

__all__ = ["STAYS", "scanner_as_it_was"]

# Shares of the run's passes that a first fit may take which no question needs. A scanner that has moved costs many
# decibels in a quick run, too; gains and drift are found by the run as well. Large detectors are asked otherwise.
_OF_MOVES, _OF_LIGHT = 0.2, 0.1

# Facts that a run which begins anew, or goes on, does not find again.
STAYS = ("alignment", "bowtie", EARLY_LIGHT, "gains", "drift")


def scanner_as_it_was(
    problem: Problem,
    moved: str | Sequence[str] | None,
    options: RunOptions,
    saved: Checkpoint | None,
    report: Callable[[float, str], Any],
) -> tuple[Problem, dict[str, Answer], Lab | None]:
    """The problem by the scanner as it stood, without the gains and the drift that a first fit tells.

    Parameters
    ----------
    problem : Problem
        As told.
    moved : "auto", "usual", names of moves, or None
        Which moves of the scanner the rays are asked about (`plan.alignment`).
    options : RunOptions
    saved : Checkpoint or None
        Whose plan knows all of it.
    report : callable
        Gets the share done, and words.

    Returns
    -------
    problem : Problem
    facts : dict of str to Answer
        What a plan tells of that.
    lab : Lab or None
        Of that problem, where the first fit found nothing.
    """
    if saved is not None and saved.plan is not None:
        facts = {name: saved.plan.facts[name] for name in STAYS if name in saved.plan.facts}
        problem = problem if moved is None else aligned(problem, facts["alignment"].value)
        saved.share_early(problem, options.device)
        return problem, facts, None
    if options.time_budget is not None:
        found = find_axis(problem, options, report) if moved is not None else None
        return aligned(problem, found.value if found else {}), _facts(found), None
    found, lab = None, None
    if moved == "auto":
        found, lab = _found(problem, options, report)
    elif moved is not None:
        # Names are asked for as they stand: who leaves out "u" does not want the axis moved.
        axis = find_axis(problem, options, report) if moved == "usual" else None
        found = align(problem, moved, options, axis, report)
    if lab is None:
        report(0.0, "start volume")
        lab = lab_of(aligned(problem, found.value if found else {}), Plan(), options)
    look = first_look(lab, _OF_MOVES if moved == "auto" and not is_joined(problem) else _OF_LIGHT)
    light = {} if look is None else take_out_early(look, options.settings)
    return lab.problem, _facts(found) | light, None if light else lab


def _facts(alignment: Answer | None) -> dict[str, Answer]:
    return {} if alignment is None else {"alignment": alignment}


def _found(
    problem: Problem, options: RunOptions, report: Callable[[float, str], Any]
) -> tuple[Answer, Lab | None]:
    """Moves that are looked for by default, and a lab by these, where it was made on the way."""
    axis = find_axis(problem, options, report)
    if is_joined(problem):
        # All of it is not made before it is known where it stood.
        return realigned(problem, axis, None, options, report), None
    report(0.0, "start volume")
    lab = lab_of(aligned(problem, axis.value), Plan(), options)
    found = realigned(problem, axis, first_look(lab, _OF_MOVES), options, report)
    return found, lab if found is axis else None

"""The fit of a scan from its physics to the fitted Gaussians, begun anew where the rays show other physics."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.optimise import Course, FitOutcome, Run, fit
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.stopping import Clock, FitState, Stop, StopReason
from tomo_polysplat.fit.surroundings import cut_out
from tomo_polysplat.kernels.compile_time import compiled_seconds, working_time
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.bowtie import behind_bowtie, find_bowtie
from tomo_polysplat.plan.calibration import Calibration
from tomo_polysplat.plan.checkpoint import Checkpoint
from tomo_polysplat.plan.decision import When
from tomo_polysplat.plan.expected import expected, tell
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.never_worse import judge, note_seeds
from tomo_polysplat.plan.order import ask_between, decide
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.preparation import (
    PreparedFit,
    RunOptions,
    calibrate,
    no_result_yet,
    physics,
    prepare,
    under,
)
from tomo_polysplat.plan.scanner_as_it_was import STAYS, scanner_as_it_was
from tomo_polysplat.plan.steady_light import SteadyLight

__all__ = ["Solver"]

logger = logging.getLogger(__name__)

# Seconds that are kept for what comes after the fit besides the volume, where there is a time budget.
_FINISHING = 0.03


@dataclass(frozen=True)
class Solver:
    """How a scan is fitted.

    Attributes
    ----------
    run_options : RunOptions
    saved : Checkpoint or None
    started : float
        When the reconstruction began, in seconds of ``kernels.compile_time.working_time``.
    flipped : bool
        Whether callbacks get slices with row 0 at the largest y.
    moved : "auto", "usual", names of moves, or None
        Which moves of the scanner the rays are asked about (`plan.alignment`).
    report : callable
        Gets the share done, and words.
    bowtie : bool
        Whether the rays are asked about a bowtie filter (`plan.bowtie`).
    compiled : float
        Seconds that this process had compiled for before.
    """

    run_options: RunOptions
    saved: Checkpoint | None
    started: float
    flipped: bool
    report: Callable[[float, str], Any]
    moved: str | Sequence[str] | None = None
    bowtie: bool = False
    compiled: float = field(default_factory=compiled_seconds)

    def solve(
        self, problem: Problem, wanted: Calibration | None, *, ask_scatter: bool
    ) -> tuple[Problem, PreparedFit, FitOutcome]:
        """The problem under the physics that were found, with what its fit began from and came to.

        Parameters
        ----------
        problem : Problem
        wanted : Calibration or None
            What is calibrated first.
        ask_scatter : bool
            Whether the rays are asked about scatter on the way.

        Raises
        ------
        KeyboardInterrupt
            After Ctrl-C before the fit has begun.
        """
        with no_result_yet():
            told, facts, lab = scanner_as_it_was(
                problem, self.moved, self.run_options, self.saved, self.report
            )
            filters = self._filters(told)
        behind = behind_bowtie(told, {} if filters is None else filters.value)
        problem, plan = physics(behind, wanted, self.run_options, self.saved, self.report)
        plan.facts |= facts if filters is None else facts | {"bowtie": filters}
        # Other physics have another start.
        lab = lab if problem is told else None
        prepared = prepare(problem, plan, self.run_options, self.saved, self.report, lab, self._end)
        # A GPU has room for its short fits no longer.
        del lab
        if self.saved is not None:
            self.saved.share_taken(problem)
        outcome = self._fit(prepared, problem, ask_scatter)
        if outcome.restart is not None:
            problem, prepared, outcome = self._anew(problem, prepared, outcome)
        try:
            self._judge(problem, prepared, outcome)
        except KeyboardInterrupt:
            logger.warning("Interrupted: how the rays are missed is not told.")
        return problem, prepared, outcome

    def _judge(self, problem: Problem, prepared: PreparedFit, outcome: FitOutcome) -> None:
        """Fall back to the start where the fit explains the rays no better; the plan says how they are missed."""
        options = self.run_options
        behind = judge(outcome, prepared, problem, options)
        if not behind:
            return
        start = prepared.start
        if start is None:
            start = first_volume(problem, options.device, options.settings)[0].cpu()
        outcome.start = start
        nothing = torch.empty(0, dtype=torch.int64, device=outcome.gaussians.position.device)
        outcome.gaussians = outcome.gaussians.select(nothing)
        words = "the fit explains the rays no better, or too little to have regained what its seeds had lost"
        prepared.plan.note("returned", "start", f"{words}: the volume is the one that it began from")
        logger.warning("The start volume is returned: %s.", prepared.plan.facts["returned"].why)

    def _filters(self, problem: Problem) -> Answer | None:
        """What the rays tell of a bowtie, which a checkpoint's plan knows; None where they are not asked."""
        if not self.bowtie:
            return None
        if self.saved is not None and self.saved.plan is not None:
            return self.saved.plan.facts["bowtie"]
        return find_bowtie(problem, self.run_options, self.report)

    def _anew(
        self, problem: Problem, prepared: PreparedFit, so_far: FitOutcome
    ) -> tuple[Problem, PreparedFit, FitOutcome]:
        """What `solve` gives, under other physics than those that a fit had begun with."""
        found = so_far.restart
        other, plan = under(problem, found)
        plan.facts |= {name: fact for name, fact in prepared.plan.facts.items() if name in STAYS}
        try:
            anew = prepare(other, plan, self.run_options, self.saved, self.report, end=self._end)
            outcome = self._fit(anew, other, ask_scatter=False)
            if outcome.history or outcome.stop is None or outcome.stop.reason is not StopReason.INTERRUPTED:
                return other, anew, outcome
        except KeyboardInterrupt:
            logger.warning("Interrupted before the fit had begun anew; what it had come to is returned.")
        prepared.plan.answers["scatter"] = Answer(
            {}, f"not modelled: interrupted; {found['why']}", Status.USUAL
        )
        so_far.stop = Stop(StopReason.INTERRUPTED, "interrupted")
        return problem, prepared, so_far

    def _fit(self, prepared: PreparedFit, problem: Problem, ask_scatter: bool) -> FitOutcome:
        plan, scene, run_options = prepared.plan, prepared.scene, self.run_options
        try:
            note_seeds(prepared, problem, run_options)
        except KeyboardInterrupt:
            logger.warning("Interrupted before the first step; what it would have begun with is returned.")
            return FitOutcome(prepared.gaussians, stop=Stop(StopReason.INTERRUPTED, "interrupted"))
        settings = plan.adapted(plan.with_agent(run_options.settings))
        told = _Told(self.report)
        course = Course(
            views_per_step=plan.views_per_step,
            rng=np.random.default_rng(run_options.seed),
            started=self.started,
            deadline=self._deadline(prepared),
            volume=_volume_of(scene, plan, problem, self.flipped),
            callbacks=[told.passed, *run_options.callbacks],
            checkpoint=self.saved,
            between=self._questions(prepared, problem, ask_scatter),
            pace=lambda room, lacking: self._tell_pace(plan, room, lacking),
            tick=told.tick,
            timed=lambda clock, a_step: self._tell_expected(prepared, clock, a_step),
        )
        settings = replace(settings, passes=plan.passes)
        spacing = plan.spacing * problem.voxel
        return fit(FitSetup(prepared.gaussians, spacing, prepared.rays, scene, settings), course)

    def _tell_expected(self, prepared: PreparedFit, clock: Clock, a_step: float) -> None:
        """Say what the run will take, once some steps have been timed."""
        plan, so_far = prepared.plan, working_time() - self.started
        growth = plan.answers["growth"].value if "growth" in plan.answers else 1.0
        memory = plan.facts["memory"].why if "memory" in plan.facts else ""
        parts = clock.steps, clock.done, a_step, so_far, float(growth), f"memory {memory}"
        compiled, light_open = compiled_seconds() - self.compiled, "pixel_rays" not in plan.answers
        found = expected(*parts, light_open=light_open, compiled=compiled)
        tell(found, self.run_options.time_budget)

    def _tell_pace(self, plan: Plan, room: float, lacking: float) -> None:
        """Say for how much of the run the time budget has room, at its beginning."""
        budget = self.run_options.time_budget
        if room >= 1:
            plan.note("time_budget", room, "room for the whole run")
            return
        words = f"room for about {room:.0%} of the run; all of it would take about {lacking:.2g} s more"
        plan.note("time_budget", room, words)
        logger.warning("The time budget of %g s has %s. Fine detail will be missing.", budget, words)

    def _questions(self, prepared: PreparedFit, problem: Problem, ask_scatter: bool) -> Callable[[Run], None]:
        """What asks between two passes what the plan has left open; what need not be asked is answered now."""
        options = self.run_options

        def scatter() -> dict[str, Any]:
            self.report(0.0, "scatter")
            found = calibrate(problem, Calibration(("scatter",), None, suspected=True), options)
            if not found["accepted"]["scatter"]:
                problem.let_go_of_level()
            return found

        lab = Lab(problem, None, options.settings, options.device, plan=prepared.plan)
        lab.calibrate, lab.gaussians = scatter if ask_scatter else None, prepared.gaussians
        decide(lab, When.DURING)
        lab.gaussians = None
        steady = SteadyLight(problem, prepared.plan, options.settings)

        def between(run: Run) -> None:
            steady.between(run)
            ask_between(lab, run)

        return between

    @property
    def _end(self) -> float | None:
        """When the time budget ends."""
        budget = self.run_options.time_budget
        return None if budget is None else self.started + budget

    def _deadline(self, prepared: PreparedFit) -> float | None:
        """When the fit ends at the latest, so that the volume is made in time."""
        if (end := self._end) is None:
            return None
        # A volume that takes most of the budget still needs a fit: then the end is late.
        left = max(end - working_time(), 0.0)
        volume = prepared.plan.growth * prepared.scene.seconds_of_basis(prepared.gaussians)
        return end - min(volume + _FINISHING, 0.5 * left)


class _Told:
    """How far a fit is, after each of its passes and meanwhile."""

    def __init__(self, report: Callable[[float, str], Any]) -> None:
        self._report, self._words = report, "first pass"

    def passed(self, state: FitState) -> None:
        """After a pass."""
        self._words = state.describe()
        self._report(state.share, self._words)

    def tick(self, share: float) -> None:
        """Within one."""
        self._report(share, self._words)


def _volume_of(
    scene: FitScene, plan: Plan, problem: Problem, flipped: bool
) -> Callable[[Gaussians], np.ndarray]:
    """A function from Gaussians to the volume in 1/unit, for callbacks."""
    factor = plan.reference * problem.soft_attenuation()

    def volume(gaussians: Gaussians) -> np.ndarray:
        with torch.no_grad():
            whole = cut_out(scene.volume_on_host(gaussians, factor), problem.margin)
        return np.ascontiguousarray(whole[0, ::-1]) if flipped else whole

    return volume

"""How often every view is used."""

from __future__ import annotations

import math

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.stopping import usual_patience
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known
from tomo_polysplat.plan.decisions.seed_spacing import SeedSpacing
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.resolution import cells

__all__ = ["Passes", "longer", "times_of_few_views", "usual_passes"]

# Passes of a run that nobody has given a length, and of slices. By 15 passes instead of 10 six scenes of 48^3 gain 0.6
# dB without metal in the mean and 0.2 everywhere, and take a fifth more time, those of 128^3 on an H200 0.4 and 0.2 in
# a sixth more; with 20 passes 0.1 dB more in a sixth more time yet.
_PASSES, _PASSES_PLANAR = 15.0, 10.0
# A run of fewer views than these makes more passes, so that it uses as many views in all, but no more than the second
# number times the usual passes: 12 to 36 views, six volumes of 36^3, came to 32.0 / 44.0 dB in 3.7 s by 10 passes, and
# to 32.9 / 44.5 in 6.5 s so (33.2 / 44.6 in 8.2 s by 40).
_MANY_VIEWS, _MOST_TIMES = 45, 3.0
# Steps of a small cloud cost little: with fewer seeds in matter than the second number a run makes more of them, by up
# to the first, and a third as many more passes. Ten volumes of 26^3 to 34^3, steps of two views: 33.3 / 39.4 dB in 15
# passes, 33.5 / 39.8 in 20, for a fifth more time; steps of one view in 15 passes 33.4 / 39.7, for a third more. Of
# 36^3 to 40^3, four with 10 000 to 11 000 seeds gain 0.3 / 1.6 dB for a third more time, two with more seeds nothing.
# Slices, of which larger ones gain, too, are made longer in passes as much (128^2, twice the passes: steel wires 26.4
# to 28.3, soft tissue 44.2 to 45.4), but not the fan-beam slices (22 000 seeds, 1.5 times the passes: 39.6 to 39.6,
# 37.7 to 37.5): theirs go with the root.
_LONGER, _LONGER_PLANAR = (2.0, 18_000), (2.0, 36_000)
# A run of more seeds than the first uses so many views in all, in no fewer passes than the last: its time goes with
# both, and more Gaussians in fewer passes are worth more (docs/decisions/passes.md).
_LARGE, _ENOUGH_VIEWS, _FEWEST = 1e7, 9000, 4.0


class Passes(Decision):
    """How often is every view used?

    At most: the held-out rays may end the run before.
    """

    name = "passes"
    needs = (SeedSpacing,)

    def alternative(self, lab: Lab) -> str:
        """More, or an earlier end."""
        passes = lab.plan.passes
        patience = lab.settings.patience or usual_patience(passes)
        return (
            f"{2 * passes:g} for {passes:g}: twice the pairs; {patience} passes without improvement (patience) end it"
            " sooner"
        )

    def ask(self, known: Known, lab: Lab) -> Answer:
        """The usual number for the views there are, more of them for a small cloud, and fewer for a very large one."""
        problem = lab.problem
        passes = usual_passes(problem)
        more = longer(lab.support, known[SeedSpacing], problem)
        passes *= more if problem.planar else (2 + more) / 3
        if not problem.planar and _seeds(lab.support, known[SeedSpacing], problem) > _LARGE:
            passes = min(passes, max(_FEWEST, round(_ENOUGH_VIEWS / problem.geometry.views, 1)))
        patience = lab.settings.patience or usual_patience(passes)
        words = f"at most, fewer where {lab.settings.held_out:.1%} of the rays, held out of the fit,"
        return Answer(passes, f"{words} have not improved for {patience}", Status.USUAL)


def times_of_few_views(problem: Problem) -> float:
    """How many times as many passes few views are used in."""
    return min(max(1.0, _MANY_VIEWS / problem.geometry.views), _MOST_TIMES)


def usual_passes(problem: Problem) -> float:
    """Passes of a run, but for small clouds."""
    return round(times_of_few_views(problem) * (_PASSES_PLANAR if problem.planar else _PASSES), 1)


def longer(support: int, spacing: float, problem: Problem) -> float:
    """Factor of the passes for a cloud of few seeds, which lie ``spacing`` apart in ``support`` voxels of matter."""
    most, many = _LONGER_PLANAR if problem.planar else _LONGER
    ratio = many / max(1.0, _seeds(support, spacing, problem))
    return round(min(most, max(1.0, math.sqrt(ratio) if problem.planar else ratio)), 2)


def _seeds(support: int, spacing: float, problem: Problem) -> float:
    return cells(support, problem) / spacing**problem.dimensions

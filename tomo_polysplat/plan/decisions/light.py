"""Whether light soft matter is fat or thin water, asked of the rays in the middle of a run.

Fat hardens the beam less than water. A fit makes up for most of that by density, and levels of the volume do not tell
the two apart; but where there is much fat, and not all of it near the rim, rays that meet it after more or less of
other matter disagree about its density.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import numpy as np
import torch

from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.fork import fork, passes_of_a_fork, why_no_fork
from tomo_polysplat.fit.light_matter import light_gaussians, tell_light
from tomo_polysplat.fit.loss import misfit
from tomo_polysplat.fit.rays import batches_around
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, When
from tomo_polysplat.plan.decisions.curves import Curves
from tomo_polysplat.plan.decisions.passes import Passes
from tomo_polysplat.plan.decisions.soft_reference import SoftReference
from tomo_polysplat.plan.first_gaussians import why_one_run
from tomo_polysplat.plan.lab import Lab, Untold

__all__ = ["Light"]

logger = logging.getLogger(__name__)

# Share of the run after which it is asked, and the steps of each way, but for more than this share of the run: what has
# been water for half of a run takes some 70 steps to come to terms with being fat.
_FROM, _STEPS, _MOST = 0.5, 100, 0.27
# Less of the mass outside metal matters little, and tells nothing.
_LEAST = 0.1
# Fewer voxels along the longest edge do not tell, nor do slices: their steps are too few (pancreas of 28^3, 32^3, 40^3
# and 56^3: +4.5, +7.0, -0.3 and -2.4 %; of water in the place of its fat +2.2 and +3.1 % at the last two).
_FEWEST_VOXELS = 48
# What lies so far from the number that soft matter began with has shown that it is no water.
_MOVED = 0.01
# The misfit must be less, as fat, by this many of its standard errors over the views.
_CERTAIN = 2.0


class Light(Decision):
    """Is light soft matter fat, or thin water?

    "fat" or "soft".
    """

    name = "light"
    needs = (SoftReference, Curves, Passes)
    when = When.DURING
    share = _FROM

    def valid(self, value: object) -> bool:
        """One of two words."""
        return value in ("soft", "fat")

    def usual(self, known: Known, lab: Lab) -> str:
        """Less dense soft matter."""
        return "soft"

    def why_not(self, known: Known, lab: Lab) -> str:
        """Why it is not asked, if so."""
        problem = lab.problem
        if known[Curves] == 1 or not lab.gaussians:
            return "there is one material curve"
        if not lab.settings.light_u:
            return "its number would be that of other soft matter"
        if known[SoftReference]["number"] or problem.materials != Materials():
            return "fat is told from water only"
        if problem.planar or max(problem.grid.shape) < _FEWEST_VOXELS:
            return f"slices, and volumes of fewer than {_FEWEST_VOXELS} voxels along an edge, do not tell"
        why = why_no_fork(known[Passes], problem.geometry.views)
        return why or why_one_run(len(lab.gaussians), lab.plan, problem, lab.device)

    def ask(self, known: Known, lab: Lab) -> Answer:
        """The run is made both ways for some passes, and goes on as it explains the rays."""
        run = lab.run
        assert run is not None
        fitter, clock = run.fitter, run.clock
        passes = passes_of_a_fork(fitter, known[Passes], _STEPS, _MOST)
        if not clock.room_for(clock.steps - clock.done + passes * fitter.steps_of_a_pass):
            raise Untold("the time budget is kept for the fit")
        if (share := _light_mass(fitter)) < _LEAST:
            raise Untold(f"{share:.0%} of the mass is light: too little to matter")
        if abs(fitter.gaussians.shared_material[0].item() - known[SoftReference]["number"]) > _MOVED:
            raise Untold("the soft matter has found a number of its own")
        other = lab.branch(light_u=lab.settings.light_u)
        tell_light(other.gaussians, other.scene, clock.share())
        ways = fork(fitter, other, clock, passes)
        if ways.late:
            run.made = ways.was
            raise Untold("the time budget was used before the rays could tell")
        less, error = _difference(*_misfits([fitter, other]))
        fat = less > _CERTAIN * error
        run.fitter, run.made = (other, ways.other) if fat else (fitter, ways.was)
        why = f"as fat it leaves {-less:+.2%} of the misfit, give or take {error:.2%}"
        why += f" ({share:.0%} of the mass is light)"
        logger.info("Light matter is %s: %s.", "fat" if fat else "less dense soft matter", why)
        evidence = {"less": less, "error": error, "share": share}
        return Answer("fat" if fat else "soft", why, Status.ASKED, evidence)

    def alternative(self, lab: Lab) -> str:
        """Saying it saves the fork."""
        if lab.settings.light or lab.plan.curves == 1:
            return ""
        return (
            "soft or fat: not asked in the middle of the run, which takes an eighth more steps, or a quarter where"
            " they are few"
        )


@torch.no_grad()
def _light_mass(fitter: Fitter) -> float:
    """Share of the mass outside metal that is light."""
    gaussians = fitter.gaussians
    mass = gaussians.attenuation * gaussians.log_scale.sum(dim=1).exp()
    light = light_gaussians(gaussians, fitter.scene)
    return float(mass[light].sum() / mass[gaussians.group <= 0].sum().clamp(min=torch.finfo(mass.dtype).tiny))


@torch.no_grad()
def _misfits(fitters: Sequence[Fitter]) -> list[np.ndarray]:
    """Misfit of the fitted rays of each of some views around the object, by each of the fitters."""
    found: list[list[float]] = [[] for _ in fitters]
    for views, measured, weight, _ in batches_around(fitters[0].rays):
        for k, fitter in enumerate(fitters):
            predicted, _ = fitter.scene.projections(fitter.gaussians, views)
            for parts in zip(predicted.split(1), measured.split(1), weight.split(1)):
                found[k].append(float(misfit(*parts, fitter.settings)))
    return [np.array(values) for values in found]


def _difference(was: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """By what share of the first the other misfit is less, and its standard error over the views."""
    less = was - other
    return float(less.mean() / was.mean()), float(less.std(ddof=1) / math.sqrt(len(less)) / was.mean())

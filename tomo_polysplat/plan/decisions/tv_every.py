"""In every how many steps the volume is smoothed."""

from __future__ import annotations

import math

from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known
from tomo_polysplat.plan.lab import Lab

__all__ = ["TvEvery"]

# Voxels take 40 % of a step. Smoothed at every other step, twice as much, volumes are the same in 10 to 30 % less time
# (twelve scans of 32^3 to 64^3 on a CPU: -0.03 dB without metal and 0.0 everywhere in the mean, -0.17 at most; seven
# of 64^3 and 128^3 on an H200: 0.0), and larger ones, which would take most of it, less often yet. Too seldom, in a
# CPU's 300 steps or a GPU's 900, they are smoothed by leaps, which upset the optimiser's sense of scale (pins, 64^3,
# 300 steps: 35.7, 35.6 and 35.1 dB at every second, fourth and eighth). In slices voxels take less: a casting of 128^2
# lost 0.1 dB by every other step, and bone of 1024^2 with a screw 1.8 by every eighth, for no time on a GPU.
_USUAL, _USUAL_PLANAR, _RARELY = 2, 1, {"cpu": 4, "cuda": 8}
# Voxels that a step can smooth while it does the rest.
_VOXELS = {"cpu": 140_000, "cuda": 4_200_000}


class TvEvery(Decision):
    """In every how many steps is the volume smoothed?

    It then counts as many times.
    """

    name = "tv_every"

    def valid(self, value: object) -> bool:
        """A whole number."""
        return type(value) is int and value > 0

    def ask(self, known: Known, lab: Lab) -> Answer:
        """As often as steps have time for."""
        device, usual = lab.device.type, _USUAL_PLANAR if lab.problem.planar else _USUAL
        every = min(max(-(-math.prod(lab.start.shape) // _VOXELS[device]), usual), _RARELY[device])
        return Answer(
            every, "the volume is smoothed in one step of so many: what steps have time for", Status.ASKED
        )

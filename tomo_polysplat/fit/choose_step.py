"""Which form of the optimiser's step a run takes."""

from __future__ import annotations

import logging

import torch

from tomo_polysplat.fit.led_step import LedStep
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.shares import Part
from tomo_polysplat.fit.step import EagerStep, Step
from tomo_polysplat.ranks import ALONE, Ranks, current_ranks
from tomo_polysplat.settings import Settings

__all__ = ["NoRoom", "make_step", "own_step", "why_eager"]

logger = logging.getLogger(__name__)


class NoRoom(torch.cuda.OutOfMemoryError):
    """A GPU has no room for a step, that of any of the ranks, which all go on without it."""


def why_eager(scene: FitScene, settings: Settings) -> str:
    """Why a step cannot be one graph of our own kernels; nothing if it can."""
    if scene.kernel != "triton":
        return f"the {scene.kernel} kernel runs"
    if settings.ssim_weight:
        return "structural similarity is asked for"
    return ""


def make_step(setup: FitSetup, *, batch: int, beside: Step | None = None) -> Step:
    """A CUDA graph where there can be one, else operation by operation; shared out over ranks, if there are several.

    Parameters
    ----------
    setup : FitSetup
    batch : int
        Views of a step.
    beside : Step, optional
        Another one of the same run, never made at the same time.

    Raises
    ------
    NoRoom
        Where a GPU has no room for the graph: operation by operation would need more.
    """
    ranks = current_ranks()
    if ranks.count == 1 or len(setup.gaussians) < ranks.count:
        return own_step(setup, batch, beside=beside)
    led = beside if isinstance(beside, LedStep) else None
    return LedStep(own_step, setup, batch, ranks, led)


def own_step(
    setup: FitSetup, batch: int, ranks: Ranks = ALONE, beside: Step | None = None, part: Part | None = None
) -> Step:
    """This process's step, of all Gaussians or of its ``part`` where all ``ranks`` make theirs; see `make_step`."""
    reason, full = why_eager(setup.scene, setup.settings), ""
    graph: Step | None = None
    if not reason:
        from tomo_polysplat.fit.graph_step import GraphStep

        try:
            shared = beside if isinstance(beside, GraphStep) else None
            graph = GraphStep(setup, batch, part, shared)
        # Of compiler or driver, of any kind: the slower way gives the same result.
        except Exception as problem:
            logger.debug("no CUDA graph", exc_info=True)
            if _of_memory(problem):
                # Its text alone: the error holds all that was made.
                full = str(problem)
            else:
                logger.warning("Steps one operation at a time: no CUDA graph could be recorded: %s", problem)
    else:
        logger.debug("Steps one operation at a time: %s.", reason)
    if ranks.total(float(bool(full)))[0]:
        graph = None  # where only another rank lacks room, for who goes on to have it
        raise NoRoom(full or "the GPU of another rank has no room for its part of a step")
    # What the two forms add up over ranks is not the same.
    if ranks.same(graph is not None) and graph is not None:
        return graph
    return EagerStep(setup, part)


def _of_memory(problem: BaseException | None) -> bool:
    """Whether an error is for want of memory, or has come of such a one: a recording that it ends may fail anew."""
    while problem is not None:
        if isinstance(problem, torch.cuda.OutOfMemoryError) or "out of memory" in str(problem):
            return True
        problem = problem.__context__
    return False

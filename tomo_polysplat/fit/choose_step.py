"""Which form of the optimiser's step a run takes."""

from __future__ import annotations

import logging

import torch

from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.step import EagerStep, Step
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["make_step", "why_eager"]

logger = logging.getLogger(__name__)


def why_eager(scene: FitScene, settings: Settings) -> str:
    """Why a step cannot be one graph of our own kernels; nothing if it can."""
    if scene.kernel != "triton":
        return f"the {scene.kernel} kernel runs"
    if settings.ssim_weight:
        return "structural similarity is asked for"
    return ""


# All that a fit is made of, and the run beside it.
def make_step(
    gaussians: Gaussians,
    spacing: float,
    rays: Rays,
    scene: FitScene,
    settings: Settings,
    *,
    batch: int,
    beside: Step | None = None,
) -> Step:
    """A CUDA graph where there can be one, else operation by operation.

    Parameters
    ----------
    batch : int
        Views of a step.
    beside : Step, optional
        Another one of the same run, never made at the same time.

    Raises
    ------
    torch.OutOfMemoryError
        Where a GPU has no room for the graph: operation by operation would need more.
    """
    reason = why_eager(scene, settings)
    if not reason:
        from tomo_polysplat.fit.graph_step import GraphStep

        try:
            shared = beside if isinstance(beside, GraphStep) else None
            return GraphStep(gaussians, spacing, rays, scene, settings, batch, shared)
        except torch.OutOfMemoryError:
            raise
        # Of compiler or driver, of any kind: the slower way gives the same result.
        except Exception as problem:
            logger.debug("no CUDA graph", exc_info=True)
            logger.warning("Steps one operation at a time: no CUDA graph could be recorded: %s", problem)
    else:
        logger.debug("Steps one operation at a time: %s.", reason)
    return EagerStep(gaussians, spacing, rays, scene, settings)

"""What a fit is made of: its Gaussians, the rays they are fitted to, and by which model and settings."""

from __future__ import annotations

from typing import NamedTuple

from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["FitSetup"]


class FitSetup(NamedTuple):
    """What a fit, and every step of its optimiser, is made of.

    Attributes
    ----------
    gaussians : Gaussians
        The cloud of n Gaussians, in the solver's coordinates. Steps change its tensors in place; their addresses stay.
    spacing : float
        Distance of neighbouring seeds, in the solver's unit of length. The largest deviation of a Gaussian and the
        learning rate of positions go with it.
    rays : Rays
        The measured (views, rows, columns) -log(I/I0), without unit, and the views they belong to.
    scene : FitScene
        The forward model, from Gaussians to what the rays would measure.
    settings : Settings
        Weights of the loss, smoothing, and learning rates; `Fitter` makes these the rates of a run of so many steps.
    """

    gaussians: Gaussians
    spacing: float
    rays: Rays
    scene: FitScene
    settings: Settings

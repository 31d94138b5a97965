"""A first fit, of a pass or less, that shows what scanner and source did before the questions of a run.

It is the fit that asks how sharp edges are (`plan.decisions.edges`), made a little earlier. Where nothing has moved,
and the light was steady, the questions go on with what was made for it.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.plan.decisions.edges import Edges, settings_of_trial, why_no_trial
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.ranks import current_ranks
from tomo_polysplat.settings import Settings

__all__ = ["Look", "first_look"]

logger = logging.getLogger(__name__)

# Where no question needs this fit, it takes so many passes.
_PASSES = 1.0


@dataclass(frozen=True)
class Look:
    """A short fit of round seeds.

    Attributes
    ----------
    lab : Lab
        Which has made it, with the problem, the forward model and the rays.
    gaussians : Gaussians
    settings : Settings
        Of the fit.
    """

    lab: Lab
    gaussians: Gaussians
    settings: Settings


def first_look(lab: Lab, share: float) -> Look | None:
    """The first fit; None where it would take too large a part of the run, or fails. It is made once.

    Parameters
    ----------
    lab : Lab
    share : float
        Of the run's passes, that the fit may take where no question needs it.
    """
    try:
        settings = _settings(lab, share)
        if settings is None or not len(lab.seeds(edges="blurred")):
            return None
        return Look(lab, lab.trial(settings, edges="blurred").gaussians, settings)
    except Exception as broken:
        # Processes that share the steps may be left behind by one that fails.
        if current_ranks().count > 1:
            raise
        logger.warning("A short fit failed, so the scanner stays where it is: %r", broken)
        return None


def _settings(lab: Lab, share: float) -> Settings | None:
    """Of the fit, None where it would take too long."""
    settings, plan = settings_of_trial(lab), lab.plan
    if Edges().given(lab.settings) is None and not why_no_trial(plan.spacing, plan.passes, lab):
        return settings
    passes = min(settings.passes or _PASSES, _PASSES)
    return replace(settings, passes=passes) if passes <= share * plan.passes else None

"""Whether a scan's start explains its rays better by one energy than by the spectrum that was told."""

from __future__ import annotations

import logging
import math

import torch

from tomo_polysplat.fit.misses import misses
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.order import decide_start
from tomo_polysplat.settings import Settings

__all__ = ["doubt_spectrum"]

logger = logging.getLogger(__name__)

# The spectrum is doubted where first Gaussians of one energy leave less than this share of its misfit. Under their own
# spectrum of 90 kV pins, teeth and pepper of 26^3, with and without metal, leave 0.96 to 1.22, with 140 kV told for it
# 0.97 to 1.21, with 40 kV 0.84 to 1.03, and with a bare tube of 60 kV 0.43 to 0.84, but pins without metal 1.22.
_CLEARLY = 0.85
# It takes a second start, which of more voxels is not cheap.
_MOST_VOXELS = 1 << 27


def doubt_spectrum(
    problem: Problem, misfit: float, settings: Settings, device: torch.device
) -> Answer | None:
    """What to do about a spectrum that fits rays clearly worse than one energy does; None for no doubt.

    Parameters
    ----------
    problem : Problem
    misfit : float
        Of its first Gaussians.
    settings : Settings
    device : torch.device
    """
    if not problem.polychromatic or math.prod(problem.grid.shape) > _MOST_VOXELS or misfit <= 0:
        return None
    one = problem.with_one_energy()
    try:
        start, _ = first_volume(one, device, settings)
        lab = Lab(one, start, settings, device)
        decide_start(lab)
        ratio = misses(lab.seeds(), lab.scene, lab.rays, one.photons(device), settings).misfit / misfit
    except (ValueError, RuntimeError, MemoryError) as error:  # no room for it, or no such start
        logger.info("The spectrum is not compared with one energy: %s", error)
        return None
    if ratio >= _CLEARLY:
        return None
    words = (
        f"before the fit one energy leaves {ratio:.2f} of the misfit of the rays that the spectrum leaves: either the"
        " rays were corrected for hardening, then pass water_correction= or no spectrum, or the spectrum is not that of"
        " this scan: look at its voltage, filters and detector (docs/spectrum.md)"
    )
    logger.warning("The spectrum does not fit: %s.", words)
    return Answer("doubted", words, Status.FOUND, {"left by one energy": ratio})

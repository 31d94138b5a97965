"""Whether a scan's rays show that its spectrum is not theirs: by the mass of each view, or by one energy."""

from __future__ import annotations

import logging
import math
from dataclasses import replace

import torch

from tomo_polysplat.fit.misses import misses
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.physics.typical import largest_finite
from tomo_polysplat.physics.water_correction import usual_water_correction
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.coarse import coarse_settings, small_problem
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.order import decide_start
from tomo_polysplat.plan.short_fit import short_fit
from tomo_polysplat.scan.mass_of_views import hardening_shown
from tomo_polysplat.start.initial import initial_volume_on

__all__ = ["doubt_spectrum"]

logger = logging.getLogger(__name__)

# Short fits are made where first Gaussians of one energy leave less than this share of the spectrum's misfit, and the
# spectrum is doubted where such a fit does, too. Pins, teeth, pepper and lung of 26^3 and 36^3, with and without metal:
# under their own spectrum of 90 kV 0.98 to 1.23 before and 0.92 to 1.33 after the fit; told 40 kV 0.89 to 1.11 and 0.88
# to 1.05; told a bare tube of 60 kV 0.46 to 1.22 and 0.46 to 1.55.
_CLEARLY = 0.9
# It takes a second start, which of more voxels is not cheap.
_MOST_VOXELS = 1 << 24
# Short fits of more pixels than those are of joined ones, of which at least so many columns are left.
_COLUMNS = 36


def doubt_spectrum(problem: Problem, misfit: float, options: FitOptions) -> Answer | None:
    """What to do about a spectrum whose hardening the rays do not show, or that one energy beats; None for no doubt.

    Parameters
    ----------
    problem : Problem
    misfit : float
        Of its first Gaussians.
    options : FitOptions
        Of the fit to come.
    """
    if (linear := _doubt_hardening(problem, options.device)) is not None:
        return linear
    if not problem.polychromatic or math.prod(problem.grid.shape) > _MOST_VOXELS or misfit <= 0:
        return None
    one = problem.with_one_energy()
    try:
        if _by_seeds(one, options) >= _CLEARLY * misfit:
            return None
        left = _after_short_fits(problem, options)
    except (ValueError, RuntimeError, MemoryError) as error:  # no room for it, or no such start
        logger.info("The spectrum is not compared with one energy: %s", error)
        return None
    ratio = left[0] / left[1] if left[1] > 0 else 1.0
    if ratio >= _CLEARLY:
        return None
    words = (
        f"after a short fit one energy leaves {ratio:.2f} of the misfit of held-out rays that the spectrum leaves:"
        " either the rays were corrected for hardening, then pass water_correction= or no spectrum, or the spectrum is"
        " not that of this scan: look at its voltage, filters and detector (docs/spectrum.md)"
    )
    logger.warning("The spectrum does not fit: %s.", words)
    return Answer("doubted", words, Status.FOUND, {"left by one energy": ratio})


def _doubt_hardening(problem: Problem, device: torch.device) -> Answer | None:
    """That the views add up to the same mass as they are, which rays of this spectrum do not; None for no doubt."""
    spectrum = problem.spectrum
    if spectrum is None or problem.filter_map is not None:
        return None
    shown = hardening_shown(problem.projections, problem.geometry, spectrum)
    if shown is None or not shown.none:
        return None
    largest = float(largest_finite(problem.measured(device)))
    if largest <= 0:
        return None
    polynomial = ", ".join(f"{c:.6g}" for c in usual_water_correction(spectrum, largest))
    words = (
        f"all views see the same mass, which shows {shown.share:.2f} (standard error {shown.error:.2g}) of the"
        " spectrum's hardening: either the scanner has corrected its rays for water, then pass its polynomial, or the"
        f" usual one of this spectrum, water_correction=({polynomial}); or the beam has one energy, then pass no"
        " spectrum; or the spectrum is far too soft (docs/spectrum.md)"
    )
    logger.warning("The spectrum does not fit: %s.", words)
    return Answer("doubted", words, Status.FOUND, shown._asdict())


def _by_seeds(one: Problem, options: FitOptions) -> float:
    """Misfit of the first Gaussians, of a start that bridges no metal: that takes longer, and is for the short fit."""
    # How a volume is smoothed is nothing to its seeds, and takes two more volumes to decide.
    settings, device = replace(options.settings, tv_weight=0.0), options.device
    start, _ = initial_volume_on(one.primary(device), one.geometry, one.grid)
    lab = Lab(one, start, settings, device)
    decide_start(lab)
    return misses(lab.seeds(), lab.scene, lab.rays, one.noise(device), settings).misfit


def _after_short_fits(problem: Problem, options: FitOptions) -> list[float]:
    """Held-out misfits of one energy and of the spectrum: large scans are asked by joined pixels, which cost little."""
    if problem.geometry.columns >= 2 * _COLUMNS:
        problem = small_problem(problem, _COLUMNS)
        options = replace(options, settings=coarse_settings(options.settings))
    left = []
    for of in (problem.with_one_energy(), problem):
        start, _ = first_volume(of, options.device, options.settings)
        left.append(short_fit(of, start, {}, options).held_out)
    return left

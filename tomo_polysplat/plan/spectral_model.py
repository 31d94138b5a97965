"""The spectrum as the model of a scan sees it: its nodes, and the material curves at the energies that matter."""

from __future__ import annotations

import math
from functools import lru_cache

import torch

from tomo_polysplat.fit.problem import OPAQUE, Problem
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.filtered_rays import Behind
from tomo_polysplat.physics.material_range import LEAST_U, least_material_number
from tomo_polysplat.physics.quadrature import Quadrature, fit_quadrature
from tomo_polysplat.physics.scatter import add_scatter
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.typical import largest_finite
from tomo_polysplat.physics.water import transmitted_energy
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.settings import Settings

__all__ = ["spectral_model"]

# And to this at least: a scan of nothing has no range.
_LEAST_PROJECTION = 1e-3
# The range is rounded up to a power of this, so that short fits and scans of one kind share their nodes, whose fit
# takes as long as some dozen steps on a GPU.
_RANGE_STEP = 2.0**0.125


def spectral_model(
    problem: Problem, plan: Plan, settings: Settings, device: torch.device
) -> tuple[Quadrature | None, torch.Tensor | None, torch.Tensor | None, float]:
    """Nodes of the spectrum, the curves at the Gaussians' energy and at the volume's, and the least u.

    Of one energy there are neither nodes nor curves, and of one curve no curves. What was chosen is told in the plan.

    Parameters
    ----------
    problem : Problem
    plan : Plan
        What was chosen is noted there.
    settings : Settings
    device : torch.device
        Of the curves, ``(3,)`` each, relative to the first.
    """
    spectrum, materials = problem.spectrum, problem.materials
    if spectrum is None or materials is None:
        return None, None, None, LEAST_U
    primary = problem.primary(device)
    most = float(largest_finite(primary))
    # Mixtures of three curves are told apart by more than what thin rays use of them.
    largest = max(most, 1.0 if plan.curves > 1 else _LEAST_PROJECTION)
    rounded = _RANGE_STEP ** math.ceil(math.log(largest, _RANGE_STEP))
    nodes = settings.spectral_nodes
    behind = None if problem.filter_map is None else problem.filter_map.span
    quadrature = _fitted_nodes(spectrum, materials, min(rounded, OPAQUE), nodes, plan.curves, behind)
    plan.note("spectrum", len(quadrature.weights), quadrature.describe())
    plan.note("hardening", most, quadrature.describe_hardening(most))
    lit_by_scatter = add_scatter(quadrature, problem.scatter_level(device))
    if plan.curves == 1:
        return lit_by_scatter, None, None, LEAST_U
    least_u = least_material_number(materials, spectrum, quadrature.attenuation)
    energy = transmitted_energy(primary, spectrum)
    plan.note("reference_energy", energy, "keV: the mean of what a typical ray transmits")
    output = _relative(materials, spectrum.effective_energy, device)
    return lit_by_scatter, _relative(materials, energy, device), output, least_u


@lru_cache(maxsize=32)
def _fitted_nodes(
    spectrum: Spectrum,
    materials: Materials,
    largest: float,
    nodes: int | None,
    curves: int,
    behind: Behind | None,
) -> Quadrature:
    return fit_quadrature(spectrum, materials, largest, nodes, curves=curves, behind=behind)


def _relative(materials: Materials, energy: float, device: torch.device) -> torch.Tensor:
    """(3,) mass attenuation of the curves over that of the first."""
    attenuation = materials.mass_attenuation([energy])[:, 0]
    return torch.as_tensor(attenuation / attenuation[0], dtype=torch.float32, device=device)

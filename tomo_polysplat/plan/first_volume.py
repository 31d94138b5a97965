"""The first reconstruction, from which a fit is planned and seeded."""

from __future__ import annotations

import torch

from tomo_polysplat.fit.memory import start_stays
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.surroundings import go_on
from tomo_polysplat.free_memory import MUCH, give_back, keeps_more_than
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.water import areal_density, transmitted_energy
from tomo_polysplat.plan.decisions.soft_reference import soft_reference
from tomo_polysplat.plan.hardening import coarse, hardening_of
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.bridged import bridged_start
from tomo_polysplat.start.initial import initial_volume_on
from tomo_polysplat.transfer import copied

__all__ = ["first_volume"]

# An object of one solid looks too light as long as it is taken for water, and less so each time it is looked at.
_TIMES = 2


def first_volume(problem: Problem, device: torch.device, settings: Settings) -> tuple[torch.Tensor, str]:
    """A volume (nz, ny, nx) by classical means, and how it was made.

    Under a spectrum it is an attenuation in that of the first material of 1 g/cm3, else one per unit of length; either
    times ``problem.depth``. Rays through what shows as metal are bridged where that helps. It is on the host where the
    device has no room for what looks at it.
    """
    volume, how = _made(problem, device, settings)
    if keeps_more_than(MUCH, volume.device):
        # Anew: amid what copies of the rays took it would keep all of that from being given back.
        volume = copied(volume, torch.device("cpu"))
        give_back()
        volume = copied(volume, device)
    return volume, how


def _made(problem: Problem, device: torch.device, settings: Settings) -> tuple[torch.Tensor, str]:
    """The same where it was made."""
    solid: float | None = None
    volume, done, values = _of_one_material(solid, problem, device)
    reference = soft_reference(_looked_at(volume, device), problem, settings)
    problem.remember_solid(reference.value != reference.first)
    soft = coarse(volume) if problem.solid else None
    for _ in range(_TIMES if problem.solid else 0):
        # There may be no room for either beside what takes its place.
        del values, volume
        solid = reference.number
        volume, done, values = _of_one_material(solid, problem, device)
        reference = soft_reference(_looked_at(volume, device), problem, settings, problem.solid)
    if soft is not None:
        problem.remember_solid(problem.solid, hardening_of(soft, coarse(volume)))
    metal = reference.adapted(settings).metal_level * problem.depth * reference.value
    values = _as_if(solid, problem, device) if values is None else values
    if not values.is_cuda:
        volume = volume.cpu()
    spare = _may_change(values, problem, device)
    volume, bridged = bridged_start(
        values, volume, done["method"], problem.geometry, problem.grid, metal=metal, spare=spare
    )
    go_on(volume, problem.margin)
    return _looked_at(volume, device), f"{done['method'].upper()}: {done['reason']}{bridged}"


def _looked_at(volume: torch.Tensor, device: torch.device) -> torch.Tensor:
    """The volume where there is room for what looks at it: on the host if need be."""
    return volume if start_stays(volume.numel(), device) else volume.cpu()


def _of_one_material(
    solid: float | None, problem: Problem, device: torch.device
) -> tuple[torch.Tensor, dict[str, str], torch.Tensor | None]:
    """The volume of rays that are taken for one material's, how it was made, and these rays.

    On a GPU there may be no room for the rays beside what looks at the volume: they are made anew where needed.
    """
    values = _as_if(solid, problem, device)
    volume, done = initial_volume_on(values, problem.geometry, problem.grid, device)
    return volume, done, None if values.is_cuda else values


def _may_change(values: torch.Tensor, problem: Problem, device: torch.device) -> bool:
    """Whether these rays are nobody else's, so that they may be overwritten."""
    return values is not problem.measured(device)


def _as_if(solid: float | None, problem: Problem, device: torch.device) -> torch.Tensor:
    """Line integrals, were the object all of the first material, or of a ``solid`` of this material number."""
    return _as_if_soft(problem, device) if solid is None else _as_if_solid(problem, device, solid)


def _as_if_soft(problem: Problem, device: torch.device) -> torch.Tensor:
    """Line integrals, were the object all of the first material, of its density; for one energy of attenuation."""
    primary = problem.primary(device)
    if problem.spectrum is None or problem.materials is None:
        return primary
    spare = _may_change(primary, problem, device)
    return areal_density(primary, problem.spectrum, problem.materials.soft, spare=spare)


def _as_if_solid(problem: Problem, device: torch.device, number: float) -> torch.Tensor:
    """Line integrals, were the object all of one material number, of attenuation in that of the first material."""
    assert problem.spectrum is not None and problem.materials is not None
    primary, solid = problem.primary(device), problem.materials.mixed(max(number, 0.0))
    energy = transmitted_energy(primary, problem.spectrum)
    ratio = mass_attenuation(solid, energy) / mass_attenuation(problem.materials.soft, energy)
    spare = _may_change(primary, problem, device)
    return areal_density(primary, problem.spectrum, solid, spare=spare).mul_(float(ratio))

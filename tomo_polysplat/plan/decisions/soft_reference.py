"""What the densities and attenuations of a scan are measured by.

A fit has them in units of its *soft reference*. Under a spectrum that is water of 1 g/cm3 for tissue, plastics and all
that has something of the kind in it, and the main matter of an object that has nothing so light: a rock, a casting, a
part of metal. For one energy it is the level of the main matter whatever that is. So what counts as noise, as texture,
as nothing or as metal is told alike in a scan of any unit and of any matter.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.model.seed_samples import box_mean, widened
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.materials import MaterialLike, known_density
from tomo_polysplat.physics.solids import number_of_solid
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.water import transmitted_energy
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, is_number
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.no_object import rays_are_noise
from tomo_polysplat.plan.plan import adapted_to
from tomo_polysplat.plan.unit_check import lengths_in_doubt, refuse_lengths
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.levels import MAIN_SHARE, main_level, mass_level
from tomo_polysplat.units import Doubt

__all__ = ["Reference", "SoftReference", "lightness", "soft_reference"]

# Largest density of an object of solid metal, in those of water (rods of silver: 180, of gold: 280). The unit of length
# is in doubt only beyond.
_DENSEST = 600.0
# Lighter than ten to the power of this less 1.5, that is a hundredth of water, nothing is that is not gas (foams have
# 0.015 and more); in a unit a thousand times too long solids are.
_BETWEEN_UNITS = -0.5
# Materials denser than this are named as what an object is made of; others differ from water by less than their density
# in a scan may.
_SOLID = 1.5
# Views that tell the energy of what is transmitted.
_VIEWS = 24
# Of the mass and of the voxels of an object of nothing but dense matter the shares that lie below the level of bone:
# edges, pores, and what noise and streaks make of air. Of sandstone 0.23 and 0.50, of a foam of aluminium 0.18 and
# 0.56, of a lattice of titanium 0.12 and 0.60, of plastic with glass fibres 0.26 and 0.69, of a rod of iron in water a
# third as thick 0.20 and 0.85.
_LIGHT, _LIGHT_VOXELS, _MATTER = 0.25, 0.65, 0.3
# What is lighter than this share of the level of metal has no need of a reference of its own (aluminium at 150 kV); of
# what is denser noise and inclusions would pass for metal.
_NEAR_METAL = 0.6
# Once it is no longer taken for water a solid looks lighter by up to this (quartz at 100 kV: 4.24, then 3.50), and more
# of it looks light (0.23 of the mass of sandstone, then 0.28).
_LIGHTER = 0.75
# Of an object's dense voxels more than the first share are within the factor of their median, if they are one matter
# in the main: of rocks and parts, blurred and hardened, 0.68 and more; of a battery, circuit boards, a connector, whose
# light matter the start hides, 0.54 and less.
_ONE, _FACTOR = 0.6, 1.5
# Means are taken over this many voxels an axis, so that they hold little noise. What is more than the second number
# times their deviation is matter.
_ALIKE_VOXELS, _ABOVE_NOISE, _UPPER = 3, 3.0, 0.75
# Water is taken after all where so large a share of the matter has about its density, all around it too, which edges of
# pores have not: marrow in bone of 192^3, measured by bone, left 0.91 of bone's contrast, by water 0.99 (one seed).
_LIKE_WATER, _SOFT_INSIDE = (0.6, 1.6), 0.05
# From this number on, half way from aluminium to titanium, dense matter around soft matter is a metal pipe, no bone.
_METAL = 0.52
# Material number of main matter that is not the first of curves of which nothing is known.
_BETWEEN = 0.3


class Reference(NamedTuple):
    """The soft reference, in g/cm3 of the first material, or per unit of length for one energy.

    Attributes
    ----------
    value : float
        The reference itself.
    first : float
        That of the first material: the reference, unless the object is of denser matter.
    number : float
        Material number of what the reference is.
    why : str
        In words.
    wrong_unit : bool
        Whether the unit of length looks wrong.
    dense : float
        Attenuation, in references, of dense matter that is most of the object, has soft matter in it and is no metal.
    level : float
        Of half of the object's mass, in densities of the first material; 0 for one energy.
    """

    value: float
    first: float
    number: float
    why: str = ""
    wrong_unit: bool = False
    dense: float = 0.0
    level: float = 0.0

    def adapted(self, settings: Settings) -> Settings:
        """The settings with levels and material numbers of what the object is made of."""
        return adapted_to(self.data(), settings)

    def data(self) -> dict[str, float]:
        """Its numbers."""
        return {"value": self.value, "first": self.first, "number": self.number, "dense": self.dense}


def soft_reference(
    start: np.ndarray | torch.Tensor, problem: Problem, settings: Settings, solid: bool = False
) -> Reference:
    """The soft reference of a start volume in the solver's units (`plan.first_volume`).

    ``settings.bone_level`` is where dense matter begins, in references of the first material, whose number is
    ``settings.soft_u``. ``solid`` says that the start was made as that of an object of one solid, which it then is
    though it looks lighter.
    """
    volume = torch.as_tensor(start)
    if problem.spectrum is None or problem.materials is None:
        value = main_level(volume) / problem.depth or 1.0
        why = f"{MAIN_SHARE:.0%} of the start's mass lies below it, metal not counted"
        return Reference(value, value, 0.0, why)
    level = mass_level(volume) / problem.depth
    first = _first_density(problem.materials.soft, level)
    level /= first
    if level > 0 and not 1 < level <= _DENSEST:
        factor = 1000.0 ** round((math.log10(level) - _BETWEEN_UNITS) / 3)
        if factor != 1:
            why = f"water, with lengths off by a factor of {factor:g}: the object looks {level:.3g} times as dense"
            return Reference(
                factor * first, factor * first, settings.soft_u, why, wrong_unit=True, level=level
            )
    relative = volume / (first * problem.depth)
    main = _main_solid(relative, settings, _LIGHTER if solid else 1.0)
    if not main:
        why = f"soft matter: half of the object's mass is at most {level:.3g} times as dense"
        return Reference(first, first, settings.soft_u, why, level=level)
    if _holds_soft_matter(relative, settings):
        metal = _number_of(main * first, problem, problem.spectrum) >= _METAL
        why = f"soft matter: it lies within {'metal that' if metal else 'what'} is {main:.3g} times as dense"
        return Reference(first, first, settings.soft_u, why, dense=0.0 if metal else main)
    value, number = main * first, _BETWEEN
    if settings.soft_u or settings.curves == 1:  # Asked for, or the first curve is to do for all there is.
        number = settings.soft_u
    elif problem.materials == Materials():
        number = _number_of(value, problem, problem.spectrum)
    why = "what the object's main matter would have if it were of the first material, as there is nothing like soft"
    why += f" matter; material number {number:.2f}"
    return Reference(value, first, number, why)


def lightness(relative: torch.Tensor, metal_level: float) -> float:
    """Attenuation in soft references of most matter in a start volume, at most 1; 1 where it is not told."""
    level = _above_noise(relative, metal_level)
    return 1.0 if level is None else min(level, 1.0)


def _above_noise(relative: torch.Tensor, metal_level: float) -> float | None:
    """Attenuation of most matter in a start volume that stands out of its noise; None where it is not told.

    Noise goes below zero, where there is no matter, as far as above.
    """
    # As a list: in three dimensions what a mask picks takes 24 bytes a voxel for its indices, here 8.
    mean = box_mean(relative.float(), np.minimum(_ALIKE_VOXELS, relative.shape)).reshape(-1)
    below = mean[mean < 0]
    if not len(below):
        return None
    matter = mean[(mean > _ABOVE_NOISE * below.square().mean().sqrt()) & (mean < metal_level)]
    if not len(matter):
        return None
    # Of foam most voxels show its level; of thin walls hardly any do, and the densest are closest to it.
    return float(matter.kthvalue(int(_UPPER * len(matter)) + 1).values)


def _main_solid(relative: torch.Tensor, settings: Settings, lighter: float) -> float:
    """Attenuation of the solid that an object is made of, for a volume in that of soft matter; 0 if of none.

    It may look so much lighter than one that is not known yet.
    """
    every = relative.reshape(-1)
    dense = every[every > settings.bone_level]
    matter = every.clamp(min=0).sum(dtype=torch.float64)
    if not len(dense) or dense.sum(dtype=torch.float64) < (1 - _LIGHT / lighter) * matter:
        return 0.0
    if len(dense) < (1 - _LIGHT_VOXELS / lighter) * int((every > _MATTER).sum()):
        return 0.0
    level = float(dense.median())
    alike = int(((dense > level / _FACTOR) & (dense < level * _FACTOR)).sum()) / len(dense)
    return level if level > lighter * _NEAR_METAL * settings.metal_level and alike > _ONE else 0.0


def _holds_soft_matter(relative: torch.Tensor, settings: Settings) -> bool:
    """Whether there is soft matter in what is dense, for a volume in the attenuation of soft matter."""
    mean = box_mean(relative.float(), np.minimum(3, relative.shape))
    edges = widened((relative > settings.bone_level) | (mean < _MATTER), 1)
    soft = (mean > _LIKE_WATER[0]) & (mean < _LIKE_WATER[1]) & ~edges
    return int(soft.sum()) > _SOFT_INSIDE * int((relative > _MATTER).sum())


def _number_of(value: float, problem: Problem, spectrum: Spectrum) -> float:
    """Material number of a solid of so many g/cm3 of water, by the energy that is transmitted."""
    some = problem.projections[:: -(-len(problem.projections) // _VIEWS)]
    return float(number_of_solid(value, transmitted_energy(some, spectrum)))


def _first_density(material: MaterialLike, level: float) -> float:
    """Density in g/cm3 of the first material as soft matter; that of an object mostly of it if nobody knows it."""
    known = known_density(material) or level
    return known if known > _SOLID else 1.0


class SoftReference(Decision):
    """What are densities measured by: water, or the object's main matter?

    The answer is a dict of ``value``, ``first``, ``number`` and ``dense`` (`Reference`).
    """

    name = "soft_reference"

    def given(self, settings: Settings) -> Any | None:
        """It is told by the data alone."""
        return None

    def valid(self, value: Any) -> bool:
        """Three numbers, of which the first two are above zero."""
        if not isinstance(value, dict) or set(value) != {"value", "first", "number", "dense"}:
            return False
        positive = all(is_number(value[name], 1e-9) for name in ("value", "first"))
        return positive and all(is_number(number) for number in value.values())

    def ask(self, known: Known, lab: Lab) -> Answer:
        """From the start volume."""
        found = soft_reference(lab.start, lab.problem, lab.settings, lab.problem.solid)
        unit = "g/cm3" if lab.problem.polychromatic else "per unit of length"
        level = found.level or found.value / found.first
        doubt = _doubt(level, lab) if lab.problem.polychromatic else None
        if doubt is not None and doubt.impossible and lab.settings.density_check == "refuse":
            raise refuse_lengths(doubt)
        if doubt is not None:
            lab.doubt_lengths(f"{doubt.words}: {doubt.remedy}")
        return Answer(found.data(), f"{found.value:.4g} {unit}: {found.why}", Status.ASKED)


def _doubt(level: float, lab: Lab) -> Doubt | None:
    """Whether the unit is in doubt, for half of the mass of the start at that level: noise is no light matter."""
    if rays_are_noise(lab.problem, lab.problem.photons(lab.device)):
        return None
    found = lengths_in_doubt(level, lab.problem)
    if found is None or level > 1:
        return found
    # Beside a small object most of the mass is noise, which is lighter than the object.
    start = torch.as_tensor(lab.start)
    clear = _above_noise(start, math.inf)
    return (
        found if clear is None else lengths_in_doubt(max(clear / mass_level(start), 1.0) * level, lab.problem)
    )

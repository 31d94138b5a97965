"""What a scene needs, decided from the data before the fit, with the reasons.

Densities and attenuations inside a fit are in units of the scan's *soft reference*: water of 1 g/cm3 for a
polychromatic model, and the level that holds the middle of the object's mass for a monochromatic one. So the
same settings serve a scan in any unit.
"""

from __future__ import annotations

import logging
import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.settings import Settings

__all__ = ["Plan", "make_plan", "mass_level"]

logger = logging.getLogger(__name__)

# Soft references between which lengths are believed; beyond, they are off by a power of 1000 (mm for um, say).
_BELIEVABLE = (0.03, 30.0)
# Gaussians that a laptop and a GPU fit in a time people wait for.
_MOST_GAUSSIANS = {"cpu": 60_000, "cuda": 300_000}


@dataclass
class Plan:
    """The decisions.

    Attributes
    ----------
    reference : float
        Soft reference: g/cm3, or 1/unit when monochromatic.
    spacing : float
        Distance of the seeds in voxels.
    views_per_step : int
    reasons : dict
        Decision by decision, what was chosen and why; it becomes ``Result.plan``.
    """

    reference: float
    spacing: float
    views_per_step: int
    reasons: dict[str, Any] = field(default_factory=dict)


def make_plan(
    start: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    settings: Settings,
    polychromatic: bool,
    device: str,
) -> Plan:
    """Decide from the start volume and the geometry.

    Parameters
    ----------
    start : (nz, ny, nx) array
        First reconstruction: water-equivalent g/cm3, or 1/unit when monochromatic.
    geometry, grid : Geometry, VolumeGrid
    settings : Settings
        Zero stands for "decide", anything else is taken as it is.
    device : "cpu" or "cuda"
    """
    planar = geometry.planar and grid.planar
    reference, why = _reference(start, polychromatic)
    support = int((start > settings.support_level * reference).sum())
    most = settings.max_gaussians or _MOST_GAUSSIANS[device]
    finest, because = _finest_spacing(geometry, grid, planar)
    spacing = settings.seed_spacing
    if spacing:
        because = "asked for"
    else:
        crowded = (support / most) ** (1 / (2 if planar else 3))
        spacing = max(finest, crowded)
        if crowded > finest:
            because = f"at most {most} Gaussians over {support} voxels of support"
    views = settings.views_per_step or _views_per_step(geometry, planar)
    plan = Plan(reference, spacing, views)
    plan.reasons = {
        "model": "polychromatic: a spectrum was given"
        if polychromatic
        else "monochromatic: no spectrum was given",
        "dimensions": "2D Gaussians: one row and one slice in one plane" if planar else "3D Gaussians",
        "soft_reference": f"{reference:.4g} {'g/cm3' if polychromatic else 'per unit of length'}: {why}",
        "support": f"{support} of {start.size} voxels hold more than {settings.support_level:g} soft references",
        "seed_spacing_voxels": f"{spacing:.2f}: {because}",
        "views_per_step": f"{views} of {geometry.views}",
    }
    return plan


def mass_level(volume: np.ndarray) -> float:
    """The value below which half the mass of a volume lies: its main matter, whatever noise and metal do."""
    values = volume[volume > 0].astype(np.float64)
    if not len(values):
        return 0.0
    values.sort()
    mass = np.cumsum(values)
    return float(values[np.searchsorted(mass, 0.5 * mass[-1])])


def _reference(start: np.ndarray, polychromatic: bool) -> tuple[float, str]:
    level = mass_level(start)
    if not polychromatic:
        return level or 1.0, "half of the start's mass lies below it"
    if level == 0 or _BELIEVABLE[0] < level < _BELIEVABLE[1]:
        return 1.0, "water"
    factor = 1000.0 ** round(math.log10(level) / 3)
    logger.warning(
        "The object is as dense as %.3g g/cm3 of water: the unit of length looks wrong by a factor of %g.",
        level,
        factor,
    )
    return (
        factor,
        f"water, with lengths off by a factor of {factor:g}: the object looks {level:.3g} times as dense",
    )


def _finest_spacing(geometry: Geometry, grid: VolumeGrid, planar: bool) -> tuple[float, str]:
    """Seeds no closer than the detector can tell apart, and than the voxels can show."""
    voxel = float(grid.voxel_size[: 2 if planar else 3].min())
    width, height = geometry.pixel_size_at(grid.centre)
    pixel = width if planar else math.sqrt(width * height)
    if pixel > voxel:
        return 1.3 * pixel / voxel, "1.3 detector pixels at the object"
    return 1.3, "1.3 voxels"


def _views_per_step(geometry: Geometry, planar: bool) -> int:
    """A step costs little more in two dimensions, where a view is a line."""
    return min(geometry.views, 4 if planar else 2)

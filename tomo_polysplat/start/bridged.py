"""A start that metal does not streak: its rays are bridged and the volume made once more.

Where light hardly passes metal, filtered backprojection paints bands of nothing, or of twice too much, right across
the object. A fit mends values, but what was seeded where there is nothing, and not seeded where there is matter, stays.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator

import numpy as np
import torch

from tomo_polysplat.physics.typical import largest_finite
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.astra_pair import astra_has_gpu
from tomo_polysplat.start.initial import initial_volume_on
from tomo_polysplat.start.levels import mass_level
from tomo_polysplat.start.on_gpu import fill_rows
from tomo_polysplat.start.voxel_projector import ProjectorPair, projector_pair

__all__ = ["THIN", "bridged_start", "normalising_volume"]

_log = logging.getLogger(__name__)

# Attenuation, in multiples of the main matter, between which a voxel of the prior is made all soft matter.
_AIR, _BONE = 0.4, 1.5
# Rays whose prior is below this share of the largest are not normalised: they would only amplify noise.
THIN = 0.02
# A trace that covers more of the object's rays than this leaves too few to bridge it with.
_MOST_OF_RAYS = 0.5
# Views of which the rays beside metal say which volume is the better one.
_JUDGES = 24
# Steps along all rays beyond which the two more projections would take minutes on two CPU cores.
_MOST_STEPS = 1e10
# Rays on the host that are looked at together.
_AT_ONCE = 1 << 22


def bridged_start(
    values: torch.Tensor,
    volume: torch.Tensor,
    method: str,
    geometry: Geometry,
    grid: VolumeGrid,
    *,
    metal: float,
) -> tuple[torch.Tensor, str]:
    """The start volume, made anew without the rays through metal if that explains the other rays better.

    Normalised metal artefact reduction (Meyer et al. 2010, doi:10.1118/1.3484090): the rays through metal are
    interpolated between those beside it, once divided by the projections of a prior. It invents what lay in the
    shadow of metal, and may do harm where metal is wide; so both volumes are projected, and the rays beside metal
    choose.

    Parameters
    ----------
    values : (views, rows, columns) tensor
        -log(I/I0), water-corrected where the spectrum is known; NaN where a ray is not to be used.
    volume : (nz, ny, nx) tensor
        What `initial_volume_on` made of them, by ``method``.
    geometry, grid : Geometry, VolumeGrid
    metal : float
        Attenuation above which a voxel holds metal.

    Returns
    -------
    volume : (nz, ny, nx) tensor
        With metal as the first volume has it.
    why : str
        What was done, for reports; empty without metal.
    """
    mask = volume > metal
    if not bool(mask.any()):
        return volume, ""
    if method != "fdk":
        return volume, "; metal not bridged: too few views, or not an orbit"
    if values.is_cuda and not volume.is_cuda:
        return volume, "; metal not bridged: the GPU has no room for it"
    on_gpu = values.is_cuda and astra_has_gpu()
    if not on_gpu and math.prod(geometry.shape) * max(grid.shape) > _MOST_STEPS:
        return volume, "; metal not bridged: it would take a CPU minutes"
    try:
        with projector_pair(geometry, grid, volume.device) as pair:
            return _better(values, volume, mask, geometry, grid, pair, metal)
    except RuntimeError as problem:
        if not on_gpu:
            raise
        # Torch's, or ASTRA's, whose projection needs as much memory again.
        _log.warning("The start is not bridged at metal: %s", problem)
        return volume, "; metal not bridged: the GPU has no room for it"


# A volume and its rays, and what is known of both: nothing else holds these together.
def _better(
    values: torch.Tensor,
    volume: torch.Tensor,
    mask: torch.Tensor,
    geometry: Geometry,
    grid: VolumeGrid,
    pair: ProjectorPair,
    metal: float,
) -> tuple[torch.Tensor, str]:
    """The volume or the bridged one, whichever explains the rays beside metal, and words that say so."""
    # Half a voxel: less is the blur of the threshold's edge, and a wider trace loses more than it heals.
    wide, dense = 0.5 * float(grid.voxel_size.min()), mask.float()
    least, beside = THIN * float(largest_finite(values)), values.clone()
    through, rays = 0, 0
    for some in _portions(values):
        trace = pair.forward(dense, some) > wide
        part = beside[some[0] : some[-1] + 1]
        matter = part > least
        through, rays = through + int((trace & matter).sum()), rays + int(matter.sum())
        part.masked_fill_(trace, math.nan)
    covered = through / max(rays, 1)
    if covered > _MOST_OF_RAYS:
        return volume, f"; metal not bridged: {covered:.0%} of the object's rays pass through it"
    bridged = torch.where(mask, volume, _made_without(beside, mask, geometry, grid, pair, metal))
    before, after = (_misfit(each, beside, pair) for each in (volume, bridged))
    words = f"misses the rays beside it by {after:.2g}, a start with all rays by {before:.2g}"
    if after < before:
        return (
            bridged,
            f"; the {covered:.0%} of the object's rays that pass through metal bridged, which {words}",
        )
    return volume, f"; metal not bridged, which {words}"


def normalising_volume(volume: torch.Tensor, mask: torch.Tensor, soft: float, metal: float) -> torch.Tensor:
    """What rays are divided by the projections of before they are bridged, the prior of Meyer et al. (2010).

    Air and soft matter are made uniform and bone is kept; soft matter stands for metal, so that its trace is bridged
    as if it were.

    Parameters
    ----------
    volume : (nz, ny, nx) tensor
        Made without the rays through metal.
    mask : (nz, ny, nx) bool tensor
        Voxels of metal.
    soft, metal : float
        Attenuation of the main matter, and what none exceeds.
    """
    prior = torch.where(volume > _BONE * soft, volume.clamp(max=metal), soft)
    prior[volume < _AIR * soft] = 0
    prior[mask] = soft
    return prior


def _made_without(
    beside: torch.Tensor,
    mask: torch.Tensor,
    geometry: Geometry,
    grid: VolumeGrid,
    pair: ProjectorPair,
    metal: float,
) -> torch.Tensor:
    """The volume of rays of which those through metal, NaN, are bridged."""
    first, _ = initial_volume_on(beside, geometry, grid)
    main = mass_level(first[~mask])
    prior = pair.forward(normalising_volume(first, mask, main, metal), np.arange(geometry.views))
    least = THIN * float(prior.max())
    for some in _portions(beside):
        whole = slice(some[0], some[-1] + 1)
        part, known = prior[whole], beside[whole]
        thick = part > least
        ratio = torch.where(thick, known / part.clamp(min=1e-12), 0.0)
        prior[whole] = torch.where(thick, fill_rows(ratio) * part, fill_rows(known))
    # What was bridged, in the memory of the prior.
    second, _ = initial_volume_on(prior, geometry, grid)
    return second


def _portions(rays: torch.Tensor) -> Iterator[np.ndarray]:
    """Views that are looked at together: all on a GPU, some on the host, whose memory is not to hold copies of all."""
    views = len(rays)
    at_once = views if rays.is_cuda else max(1, _AT_ONCE // rays[0].numel())
    for first in range(0, views, at_once):
        yield np.arange(first, min(first + at_once, views))


def _misfit(volume: torch.Tensor, beside: torch.Tensor, pair: ProjectorPair) -> float:
    """Mean absolute misfit of some views, metal's rays left out."""
    views = np.unique(np.linspace(0, len(beside) - 1, min(_JUDGES, len(beside))).astype(int))
    wanted = beside[torch.from_numpy(views).to(beside.device)]
    error = (pair.forward(volume.clamp(min=0), views) - wanted).abs()
    return float(error[torch.isfinite(error)].mean())

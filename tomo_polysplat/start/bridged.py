"""A start that metal does not streak: its rays are bridged and the volume made once more.

Where light hardly passes metal, filtered backprojection paints bands of nothing, or of twice too much, right across
the object. A fit mends values, but what was seeded where there is nothing, and not seeded where there is matter, stays.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Iterator

import numpy as np
import torch

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.physics.typical import largest_finite
from tomo_polysplat.ranks import RankFailed
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.astra_pair import astra_has_gpu
from tomo_polysplat.start.initial import initial_volume_on
from tomo_polysplat.start.levels import mass_level
from tomo_polysplat.start.projected import projected
from tomo_polysplat.start.voxel_projector import ProjectorPair, projector_pair
from tomo_polysplat.start.whole_rows import fill_rows

__all__ = ["THIN", "box_around", "bridged_start", "normalising_volume"]

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
# Rays that are looked at together: the memory is not to hold copies of all.
_AT_ONCE = {"cuda": 1 << 27, "cpu": 1 << 22}

# Rows and columns of a detector, the first and the one behind the last.
Window = tuple[tuple[int, int], tuple[int, int]]


# A scan, its first volume and how that was made: nothing else holds these together.
def bridged_start(
    values: torch.Tensor,
    volume: torch.Tensor,
    method: str,
    geometry: Geometry,
    grid: VolumeGrid,
    *,
    metal: float,
    spare: bool = False,
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
    spare : bool
        Whether nobody needs the ``values`` afterwards, so that they may be overwritten.

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
            return _better(values if spare else values.clone(), volume, mask, geometry, grid, pair, metal)
    except RankFailed:
        raise
    except RuntimeError as problem:
        if not on_gpu:
            raise
        # Torch's, or ASTRA's, whose projection needs as much memory again.
        _log.warning("The start is not bridged at metal: %s", problem)
        return volume, "; metal not bridged: the GPU has no room for it"


# A volume and its rays, and what is known of both: nothing else holds these together.
def _better(
    rays: torch.Tensor,
    volume: torch.Tensor,
    mask: torch.Tensor,
    geometry: Geometry,
    grid: VolumeGrid,
    pair: ProjectorPair,
    metal: float,
) -> tuple[torch.Tensor, str]:
    """The volume or the bridged one, whichever explains the rays beside metal, and words that say so.

    The rays are overwritten: copies of all of a large scan would not fit on a GPU.
    """
    covered, window = _blanked(rays, mask, geometry, grid)
    if covered > _MOST_OF_RAYS:
        return volume, f"; metal not bridged: {covered:.0%} of the object's rays pass through it"
    views = evenly_spread(len(rays), _JUDGES)
    beside = rays[torch.from_numpy(views).to(rays.device)]
    bridged = torch.where(mask, volume, _made_without(rays, mask, geometry, grid, pair, metal, window))
    before, after = (_misfit(each, views, beside, pair) for each in (volume, bridged))
    words = f"misses the rays beside it by {after:.2g}, a start with all rays by {before:.2g}"
    if after < before:
        return (
            bridged,
            f"; the {covered:.0%} of the object's rays that pass through metal bridged, which {words}",
        )
    return volume, f"; metal not bridged, which {words}"


def _blanked(
    rays: torch.Tensor, mask: torch.Tensor, geometry: Geometry, grid: VolumeGrid
) -> tuple[float, Window]:
    """Make rays through metal NaN, and tell which share of the object's rays they are, and where they end."""
    # Metal is a small part of the volume: no ray is followed outside of the box around it.
    within = box_around(mask)
    box = grid.box(within)
    with projector_pair(geometry, box, mask.device) as pair:
        dense = projected(mask[within].float(), pair, geometry, box, _portions(rays))
        return _blank(rays, dense, 0.5 * float(grid.voxel_size.min()))


def box_around(mask: torch.Tensor) -> tuple[slice, slice, slice]:
    """Slices of z, y and x that hold all of a mask (nz, ny, nx), and a voxel around where there is one."""
    found = []
    for lines in (mask.any(dim=2).any(dim=1), mask.any(dim=2).any(dim=0), mask.any(dim=1).any(dim=0)):
        first, last = lines.nonzero()[[0, -1], 0].tolist()
        found.append(slice(max(first - 1, 0), min(last + 2, len(lines))))
    return found[0], found[1], found[2]


def _blank(
    rays: torch.Tensor, dense: Iterable[tuple[np.ndarray, torch.Tensor]], wide: float
) -> tuple[float, Window]:
    """What `_blanked` does, with how far each ray goes through metal, by portions of the views.

    ``wide`` is half a voxel: less is the
    blur of the threshold's edge, and a wider trace loses more than it heals.
    """
    least, through, known = THIN * float(largest_finite(rays)), 0, 0
    rows, columns = (torch.zeros(n, dtype=torch.bool, device=rays.device) for n in rays.shape[1:])
    for some, lengths in dense:
        trace = lengths > wide
        part = rays[some[0] : some[-1] + 1]
        matter = part > least
        through, known = through + int((trace & matter).sum()), known + int(matter.sum())
        part.masked_fill_(trace, math.nan)
        met = trace.any(dim=0)
        rows, columns = rows | met.any(dim=1), columns | met.any(dim=0)
    return through / max(known, 1), (_ends(rows), _ends(columns))


def _ends(met: torch.Tensor) -> tuple[int, int]:
    """The first place that is met and the one behind the last, and one more to either side where there is one."""
    places = met.nonzero()[:, 0].tolist() or [0]
    return max(places[0] - 1, 0), min(places[-1] + 2, len(met))


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


# Rays, and all that bridges them: nothing else holds these together.
def _made_without(
    rays: torch.Tensor,
    mask: torch.Tensor,
    geometry: Geometry,
    grid: VolumeGrid,
    pair: ProjectorPair,
    metal: float,
    window: Window,
) -> torch.Tensor:
    """The volume of rays of which those through metal, NaN, are bridged in place; they end in a window."""
    first, _ = initial_volume_on(rays, geometry, grid)
    main = mass_level(first.masked_fill_(mask, 0.0))
    prior = normalising_volume(first, mask, main, metal)
    del first
    least = THIN * float(pair.forward(prior, evenly_spread(len(rays), _JUDGES)).max())
    near = geometry.cropped(*window)
    rows, columns = (slice(*ends) for ends in window)
    with projector_pair(near, grid, prior.device) as beside:
        for some, part in projected(prior, beside, near, grid, _portions(rays)):
            known = rays[some[0] : some[-1] + 1, rows, columns]
            thick = part > least
            ratio = torch.where(thick, known / part.clamp(min=1e-12), 0.0)
            known.copy_(torch.where(thick, fill_rows(ratio) * part, fill_rows(known)))
    del prior, part, known, thick, ratio
    second, _ = initial_volume_on(rays, geometry, grid)
    return second


def _portions(rays: torch.Tensor) -> Iterator[np.ndarray]:
    """Views that are looked at together."""
    views, at_once = len(rays), max(1, _AT_ONCE[rays.device.type] // rays[0].numel())
    for first in range(0, views, at_once):
        yield np.arange(first, min(first + at_once, views))


def _misfit(volume: torch.Tensor, views: np.ndarray, beside: torch.Tensor, pair: ProjectorPair) -> float:
    """Mean absolute misfit of these views, metal's rays left out."""
    error = (pair.forward(volume.clamp(min=0), views) - beside).abs()
    return float(error[torch.isfinite(error)].mean())

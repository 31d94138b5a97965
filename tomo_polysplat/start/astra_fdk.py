"""ASTRA's FDK on a GPU, where it is exact for the scan at hand."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.free_memory import free_bytes, in_gigabytes
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, to_astra
from tomo_polysplat.start.filters import ramp_response
from tomo_polysplat.start.orbit import Orbit

if TYPE_CHECKING:
    import torch

__all__ = ["fdk_cuda", "fdk_cuda_tensor", "suits_fdk_cuda"]

# Columns that ASTRA's weighting takes at once, without asking where a row ends.
_COLUMNS_AT_ONCE = 32
# Of a pixel: what views may be off an even orbit by that is told by angles. ASTRA computes in float32.
_EXACT = 1e-5
# Numbers, with what rows are padded by, that are filtered at once.
_FILTERED_AT_ONCE = 1 << 24
# What ASTRA takes for its copy of projections, in their size, and for itself.
_OF_ASTRA = 1.1


def suits_fdk_cuda(
    geometry: Geometry, grid: VolumeGrid, orbit: Orbit, uneven: float = 0.02
) -> tuple[bool, str]:
    """Whether ASTRA's FDK_CUDA may and can do a scan, and why not.

    It reads the distances from the first view, takes the views as evenly spread over a full turn and the
    detector as centred and facing the axis, and knows cubic voxels only. Without a usable GPU it would end
    the process, so that is asked first. Steps from view to view may differ by the share ``uneven`` of their mean.
    """
    import astra
    import torch

    if not (torch.cuda.is_available() and astra.use_cuda()):
        return False, "no GPU that ASTRA can use"
    if geometry.beam != "cone" or geometry.planar:
        return False, "not a 3D cone beam"
    if np.ptp(grid.voxel_size) > 1e-6 * grid.voxel_size.max():
        return False, "voxels are not cubes"
    even = orbit.full and np.ptp(orbit.steps) < uneven * orbit.steps.mean()
    if not even:
        return False, "views are not evenly spread over a full turn"
    axis = np.column_stack([np.tile(orbit.axis, (geometry.views, 1)), geometry.origin[:, 2]])
    middle = geometry.centre - geometry.origin
    towards = axis - geometry.origin
    ratio = np.einsum("vk,vk->v", middle, towards) / np.einsum("vk,vk->v", towards, towards)
    astray = np.linalg.norm(middle - ratio[:, None] * towards, axis=1)
    if (astray > 0.05 * np.linalg.norm(geometry.u, axis=1)).any() or np.ptp(ratio) > 1e-3 * ratio.mean():
        return False, "the detector is not centred on the axis"
    skew = np.einsum("vk,vk->v", geometry.u, towards) / np.linalg.norm(geometry.u, axis=1)
    if (np.abs(skew) > 1e-3 * orbit.radius).any():
        return False, "the detector does not face the axis"
    return True, "circular cone beam"


def fdk_cuda(
    projections: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    orbit: Orbit,
    *,
    filter_name: str = "ram-lak",
    device: str = "cuda",
) -> np.ndarray:
    """ASTRA's FDK_CUDA for a scan that `suits_fdk_cuda`; parameters and result are those of `fdk`."""
    import torch

    from tomo_polysplat.start.slabs import fdk_on_device

    values = torch.from_numpy(np.ascontiguousarray(projections, dtype=np.float32))
    return fdk_on_device(values, geometry, grid, orbit, filter_name, torch.device(device)).cpu().numpy()


# One call of ASTRA, with all that it needs before and leaves behind.
def fdk_cuda_tensor(
    projections: torch.Tensor, geometry: Geometry, grid: VolumeGrid, orbit: Orbit, filter_name: str
) -> torch.Tensor:
    """The same of (views, rows, columns) float32 projections on a CUDA device, where the volume stays.

    Raises
    ------
    RuntimeError
        If ASTRA failed, or left any voxel unwritten, which is how it tells that it had no room.
    """
    import astra
    import torch
    from astra.log import AstraError

    from tomo_polysplat.start.astra_pair import make_room

    index = projections.device.index
    # ASTRA takes the origin for the centre of the orbit.
    shift = -np.array([*orbit.axis, geometry.origin[:, 2].mean()])
    proj_geom, vol_geom = _in_short(geometry.shifted(shift), grid.shifted(shift))
    # ASTRA weights its input in place, and where a row is no multiple of its blocks what lies beyond the row's end as
    # well (devFDK_preweight of ASTRA 2.5). Without a margin that is the next view: every voxel was off by some percent,
    # each time by others.
    views, rows, columns = projections.shape
    width = -(-columns // _COLUMNS_AT_ONCE) * _COLUMNS_AT_ONCE
    sinogram = projections.new_zeros((rows, views, width))
    sinogram[..., :columns] = projections.transpose(0, 1)
    _filter(sinogram[..., :columns], geometry, filter_name)
    linked = astra.data3d.GPULink(sinogram.data_ptr(), columns, views, rows, width * sinogram.element_size())
    volume = torch.full(grid.shape, torch.nan, dtype=torch.float32, device=sinogram.device)
    # ASTRA works on streams of its own and asks for none of torch's, nor for the memory that torch keeps for later.
    torch.cuda.synchronize(index)
    make_room(index, _OF_ASTRA * sinogram.nbytes)
    data, algorithm, told = [], None, ""
    try:
        data.append(astra.data3d.link("-sino", proj_geom, linked))
        data.append(astra.data3d.link("-vol", vol_geom, volume))
        config = astra.astra_dict("FDK_CUDA")
        config["ProjectionDataId"], config["ReconstructionDataId"] = data
        config["option"] = {"FilterType": "none", "GPUindex": index}
        algorithm = astra.algorithm.create(config)
        astra.algorithm.run(algorithm)
    except AstraError as problem:
        # Other releases say nothing and leave voxels unwritten.
        told = f" ASTRA says: {problem}"
    finally:
        if algorithm is not None:
            astra.algorithm.delete(algorithm)
        for identifier in data:
            astra.data3d.delete(identifier)
    torch.cuda.synchronize(index)
    if told or not bool(torch.isfinite(volume).all()):
        raise RuntimeError(_no_room(sinogram, volume) + told)
    return volume


def _no_room(sinogram: torch.Tensor, volume: torch.Tensor) -> str:
    """What ASTRA needed and what there is, in words."""
    of_rays, of_voxels, free = sinogram.nbytes, volume.nbytes, free_bytes(sinogram.device)
    return (
        f"ASTRA's FDK_CUDA left voxels unwritten: beside its {in_gigabytes(of_rays)} of projections and"
        f" {in_gigabytes(of_voxels)} of voxels it needs about {in_gigabytes(of_rays)}, and"
        f" {in_gigabytes(free)} of {sinogram.device} are free."
    )


def _filter(sinogram: torch.Tensor, geometry: Geometry, filter_name: str) -> None:
    """Filter all rows of a circular cone beam (rows, views, columns), in place, as ASTRA would between its weights.

    ASTRA filters row by row, eight calls of CUDA each, which for small scans takes longer than all the rest. On an H200
    360 views of 192^2 pixels into 128^3 voxels took 20 ms, and take 11 so; 720 of 768^2 into 512^3 take 0.26 s as well.
    """
    import torch

    rows, views, columns = sinogram.shape
    length = 1 << (2 * columns - 1).bit_length()
    response = torch.from_numpy(2 * ramp_response(length, filter_name)).to(sinogram)
    # ASTRA weights rays by their obliquity before it filters: what it finds has been, and is divided by as much.
    ends = np.stack([geometry.corner[0] - geometry.origin[0], geometry.v[0], geometry.u[0]])
    first, v, u = torch.from_numpy(ends).to(sinogram.device)
    row, column = (torch.arange(count, device=sinogram.device)[:, None] for count in (rows, columns))
    rays = first + (row * v)[:, None] + column * u
    weights = (first.norm() / rays.norm(dim=2))[:, None].to(sinogram.dtype)
    at_once = max(1, _FILTERED_AT_ONCE // (views * length))
    for some, weight in zip(sinogram.split(at_once), weights.split(at_once)):
        filtered = torch.fft.irfft(torch.fft.rfft(some * weight, length) * response, length)
        some.copy_(filtered[..., :columns] / weight)


def _in_short(geometry: Geometry, grid: VolumeGrid) -> tuple[dict[str, Any], dict[str, Any]]:
    """ASTRA's geometries, that of the projections by angles where these tell all of it.

    ASTRA gets numbers as text: twelve for each of 360 views took 5 ms, one takes 1.
    """
    import astra

    exact, volume = to_astra(geometry, grid)
    angles = np.arctan2(geometry.origin[:, 0], -geometry.origin[:, 1])
    source, detector = (np.linalg.norm(ends, axis=1).mean() for ends in (geometry.origin, geometry.centre))
    width, height = (np.linalg.norm(edges, axis=1).mean() for edges in (geometry.u, geometry.v))
    out = np.column_stack([np.sin(angles), -np.cos(angles), 0 * angles])
    across = np.column_stack([np.cos(angles), np.sin(angles), 0 * angles])
    up = np.broadcast_to([0.0, 0.0, height], out.shape)
    even = np.hstack([source * out, -detector * out, width * across, up])
    if np.abs(even - exact["Vectors"]).max() > _EXACT * min(width, height):
        return exact, volume
    pixels = width, height, geometry.rows, geometry.columns
    return astra.create_proj_geom("cone", *pixels, angles, source, detector), volume

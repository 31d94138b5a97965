"""SIRT: the least-squares volume of the line integrals, without a model of energies."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.free_memory import give_back
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, to_astra
from tomo_polysplat.start import sirt as start
from tomo_polysplat.start.astra_pair import astra_has_gpu, gpu_index

__all__ = ["sirt"]

_FAILED = "ASTRA's SIRT3D_CUDA failed; is its GPU out of memory?"


def sirt(
    projections: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    *,
    iterations: int = 50,
    subsets: int = 1,
    device: str = "cpu",
) -> np.ndarray:
    """Non-negative SIRT from zero (Gregor and Benson 2008, doi:10.1109/TMI.2008.923696).

    Parameters
    ----------
    projections : (views, rows, columns) float32
        ``-log(I / I0)``; NaN is left out.
    geometry, grid : Geometry, VolumeGrid
    iterations : int
        How often every view is used.
    subsets : int
        Groups of views; the volume is updated after each. ASTRA's SIRT takes all views at once.
    device : {"cpu", "cuda", "cuda:N"}
        On a GPU, ASTRA's SIRT3D_CUDA.

    Returns
    -------
    (nz, ny, nx) float32
        Attenuation in 1/unit.

    Raises
    ------
    RuntimeError
        If ASTRA fails on a GPU, mostly for want of memory.
    """
    if device.startswith("cuda") and subsets == 1 and astra_has_gpu():
        return _sirt_cuda(projections, geometry, grid, iterations, gpu_index(device))
    return start.sirt(projections, geometry, grid, passes=iterations, subsets=subsets)


def _sirt_cuda(
    projections: np.ndarray, geometry: Geometry, grid: VolumeGrid, iterations: int, index: int
) -> np.ndarray:
    import astra
    from astra.log import AstraError

    # It asks for none of what torch keeps for later.
    give_back()
    proj_geom, vol_geom = to_astra(geometry, grid)
    ordered = np.ascontiguousarray(projections.swapaxes(0, 1), dtype=np.float32)
    usable = np.isfinite(ordered)
    volume = np.zeros(grid.shape, np.float32)
    data, algorithm = [], None

    def link(kind: str, array: np.ndarray) -> int:
        # This algorithm needs its data in host memory and copies it once; it shares these arrays.
        data.append(astra.data3d.link(kind, vol_geom if kind == "-vol" else proj_geom, array))
        return data[-1]

    try:
        config = astra.astra_dict("SIRT3D_CUDA")
        measured = np.where(usable, ordered, np.float32(0))
        config["ProjectionDataId"] = link("-sino", measured)
        config["ReconstructionDataId"] = link("-vol", volume)
        config["option"] = {"MinConstraint": 0.0, "GPUindex": index}
        if not usable.all():
            mask = usable.astype(np.float32)
            config["option"]["SinogramMaskId"] = link("-sino", mask)
        algorithm = astra.algorithm.create(config)
        astra.algorithm.run(algorithm, iterations)
    except AstraError as problem:
        raise RuntimeError(f"{_FAILED}; it says: {problem}") from problem
    finally:
        if algorithm is not None:
            astra.algorithm.delete(algorithm)
        for identifier in data:
            astra.data3d.delete(identifier)
    # Other releases say nothing, and leave the volume as it was.
    if iterations and not volume.any() and measured.max(initial=0) > 0:
        raise RuntimeError(_FAILED)
    return volume

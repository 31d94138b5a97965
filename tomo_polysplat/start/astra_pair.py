"""ASTRA's 3D projection and backprojection on torch CUDA tensors, without a copy."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType

import numpy as np
import torch

from tomo_polysplat.free_memory import free_bytes, give_back, in_gigabytes
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, to_astra

__all__ = ["AstraPair", "astra_has_gpu", "gpu_index", "make_room"]


def astra_has_gpu() -> bool:
    """Whether ASTRA can compute on a GPU; without one some of its algorithms end the process."""
    import astra

    return torch.cuda.is_available() and bool(astra.use_cuda())


def gpu_index(device: str | torch.device) -> int:
    """Number of the GPU that a torch device stands for."""
    index = torch.device(device).index
    return torch.cuda.current_device() if index is None else index


def make_room(index: int | None, size: float) -> None:
    """Give back what torch keeps of a GPU for later, where ASTRA would have fewer than so many bytes without it."""
    if torch.cuda.mem_get_info(index)[0] < size:
        give_back()


class AstraPair:
    """Line integrals of a volume of voxels, and the backprojection nearly adjoint to them.

    Parameters
    ----------
    geometry, grid : Geometry, VolumeGrid
    device : torch.device
        A CUDA device; tensors go in and come out there.

    Raises
    ------
    RuntimeError
        On use, where ASTRA refuses the geometry or has no room.
    """

    def __init__(self, geometry: Geometry, grid: VolumeGrid, device: torch.device) -> None:
        self.geometry, self.grid = geometry, grid
        self.index = gpu_index(device)
        self._projectors: dict[bytes, int] = {}

    def __enter__(self) -> AstraPair:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        import astra

        while self._projectors:
            astra.projector3d.delete(self._projectors.popitem()[1])

    def forward(self, volume: torch.Tensor, views: np.ndarray) -> torch.Tensor:
        """(views, rows, columns) line integrals of a volume (nz, ny, nx)."""
        from astra.experimental import direct_FP3D

        shape = (self.geometry.rows, len(views), self.geometry.columns)
        volume = volume.contiguous()
        projections = self._unwritten(shape, volume)
        self._call(direct_FP3D, views, volume, projections, volume.nbytes)
        return self._written(projections, volume, projections).transpose(0, 1)

    def adjoint(self, projections: torch.Tensor, views: np.ndarray) -> torch.Tensor:
        """(nz, ny, nx) backprojection of projections (views, rows, columns)."""
        from astra.experimental import direct_BP3D

        ordered = projections.transpose(0, 1).contiguous()
        volume = self._unwritten(self.grid.shape, projections)
        self._call(direct_BP3D, views, volume, ordered, ordered.nbytes)
        return self._written(volume, volume, ordered)

    def add_adjoint(self, volume: torch.Tensor, projections: torch.Tensor, views: np.ndarray) -> None:
        """Add the backprojection of projections (views, rows, columns) to a volume (nz, ny, nx), in place."""
        ordered = projections.transpose(0, 1).contiguous()
        # As in `_unwritten`.
        torch.cuda.current_stream(volume.device).synchronize()
        proj_geom, vol_geom = to_astra(self.geometry.select(views), self.grid)

        def add(projector: int, volume: torch.Tensor, ordered: torch.Tensor) -> None:
            import astra
            from astra.experimental import accumulate_BP

            # ASTRA works on torch's memory. Unlike the direct functions this one always says when it fails.
            linked = []
            try:
                linked.append(astra.data3d.link("-vol", vol_geom, volume))
                linked.append(astra.data3d.link("-sino", proj_geom, ordered))
                accumulate_BP(projector, *linked)
            finally:
                astra.data3d.delete(linked)

        self._call(add, views, volume, ordered, ordered.nbytes)

    # What ASTRA's function takes, and what of that it copies.
    def _call(
        self,
        run: Callable[..., None],
        views: np.ndarray,
        volume: torch.Tensor,
        projections: torch.Tensor,
        copied: int,
    ) -> None:
        from astra.log import AstraError

        projector = self._projector(views)
        # It makes a texture of so many bytes on its way, whose rows are padded.
        make_room(self.index, 2 * copied)
        try:
            # torch hands out tensors of the current GPU alone.
            with torch.cuda.device_of(volume):
                run(projector, volume, projections)
        except AstraError as problem:
            # Other releases say nothing, and leave the tensor unwritten.
            raise RuntimeError(f"{_no_room(volume, projections)} ASTRA says: {problem}") from problem

    def _projector(self, views: np.ndarray) -> int:
        """ASTRA's projector of some views, made once; RuntimeError where it refuses them."""
        import astra
        from astra.log import AstraError

        key = np.asarray(views, np.int64).tobytes()
        if key not in self._projectors:
            proj_geom, vol_geom = to_astra(self.geometry.select(views), self.grid)
            options = {"GPUIndex": self.index}
            try:
                self._projectors[key] = astra.create_projector("cuda3d", proj_geom, vol_geom, options)
            except AstraError as problem:
                raise RuntimeError(f"ASTRA refuses the geometry: {problem}") from problem
        return self._projectors[key]

    def _unwritten(self, shape: tuple[int, ...], like: torch.Tensor) -> torch.Tensor:
        """A tensor that shows whether it was written to.

        ASTRA returns normally when it fails here. It also works on streams of its own and asks for none of
        torch's, so what torch has still to compute must be waited for.
        """
        tensor = torch.full(shape, torch.nan, dtype=torch.float32, device=like.device)
        torch.cuda.current_stream(like.device).synchronize()
        return tensor

    @staticmethod
    def _written(tensor: torch.Tensor, volume: torch.Tensor, projections: torch.Tensor) -> torch.Tensor:
        # One element tells, and costs no pass over the tensor.
        if bool(tensor.view(-1)[0].isnan()):
            raise RuntimeError(_no_room(volume, projections))
        return tensor


def _no_room(volume: torch.Tensor, projections: torch.Tensor) -> str:
    """What ASTRA needed and what there is, in words."""
    of_rays, of_voxels = projections.nbytes, volume.nbytes
    return (
        f"ASTRA failed on {projections.device}: beside {in_gigabytes(of_rays)} of projections and"
        f" {in_gigabytes(of_voxels)} of voxels it needs as much again as what it starts from, and"
        f" {in_gigabytes(free_bytes(projections.device))} are free."
    )

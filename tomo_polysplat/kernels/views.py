"""The detector views a kernel projects onto, as plain arrays.

A view maps a point to the detector through one 3x3 matrix. With the columns of ``matrix`` being the step
``U`` from column to column, the step ``V`` from row to row and ``D``,

* cone beam: ``D`` runs from the source to pixel (0, 0); for a point ``p`` and
  ``(a, b, c) = matrix^-1 (p - origin)`` the projection is column ``a / c``, row ``b / c``, and
  ``kappa = 1 / c`` stretches ``p - origin`` to the detector plane. ``origin`` is the source.
* parallel beam: ``D`` is the ray direction; for ``(a, b, c) = matrix^-1 (p - origin)`` the projection is
  column ``a``, row ``b``. ``origin`` is the centre of pixel (0, 0).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import torch

__all__ = ["DetectorViews", "length_gradient"]


# Views a batch may have for its table to be put together from slices: no copy from the host, which would wait.
_FEW = 32


@dataclass(frozen=True, eq=False)
class DetectorViews:
    """Views of one scan.

    Parameters
    ----------
    cone : bool
        Rays leave a point (True) or are parallel (False).
    origin : (views, 3) float64
        Source, or centre of pixel (0, 0) for parallel rays.
    matrix : (views, 3, 3) float64
        Columns ``U``, ``V``, ``D`` of the module docstring.
    rows, columns : int
        Detector size.
    planar : bool
        One detector row whose rays stay in a plane of constant z: a two-dimensional scan.
    """

    cone: bool
    origin: np.ndarray
    matrix: np.ndarray
    rows: int
    columns: int
    planar: bool = False
    _tables: dict[torch.device, torch.Tensor] = field(default_factory=dict, init=False, repr=False)
    _chosen_from: tuple[DetectorViews, np.ndarray] | None = field(default=None, repr=False)

    def __len__(self) -> int:
        return len(self.origin)

    def select(self, indices: np.ndarray | list[int]) -> DetectorViews:
        """The views of these indices, in their order."""
        indices = np.arange(len(self))[indices]
        origin, matrix = self.origin[indices], self.matrix[indices]
        return DetectorViews(self.cone, origin, matrix, self.rows, self.columns, self.planar, (self, indices))

    def moved(self, vectors: np.ndarray) -> DetectorViews:
        """The same views with other :attr:`vectors`, (views, 4, 3)."""
        vectors = np.asarray(vectors, dtype=np.float64)
        # Contiguous, as kernels are compiled for.
        origin = np.ascontiguousarray(vectors[:, 0])
        matrix = np.ascontiguousarray(vectors[:, 1:].transpose(0, 2, 1))
        return DetectorViews(self.cone, origin, matrix, self.rows, self.columns, self.planar)

    def finer(self, parts: int) -> DetectorViews:
        """The same views by pixels that are parts of these: so many along columns, and along rows unless planar."""
        down = 1 if self.planar else parts
        origin, matrix = self.origin, self.matrix / np.array([parts, down, 1])
        # From the centre of pixel (0, 0) to that of its first part.
        back = self.matrix[:, :, :2] @ (0.5 / np.array([parts, down]) - 0.5)
        if self.cone:
            matrix[:, :, 2] += back
        else:
            origin = origin + back
        return DetectorViews(self.cone, origin, matrix, down * self.rows, parts * self.columns, self.planar)

    def table(self, device: torch.device) -> torch.Tensor:
        """(views, 21) float64 origin, inverse and matrix, row by row, on a device.

        It is copied there once for all views of a scan; a selection is put together from it on the device.
        """
        if device not in self._tables:
            self._tables[device] = self._build_table(device)
        return self._tables[device]

    def _build_table(self, device: torch.device) -> torch.Tensor:
        count = len(self)
        if self._chosen_from is not None and 0 < count <= _FEW:
            whole, indices = self._chosen_from
            table = whole.table(device)
            return torch.cat([table[k : k + 1] for k in indices.tolist()])
        # From ordinary memory the copy is staged at once: it neither waits for the device nor races with numpy.
        return torch.from_numpy(self.host_table()).to(device, non_blocking=True)

    def host_table(self) -> np.ndarray:
        """(views, 21) float64 origin, inverse and matrix, row by row."""
        count = len(self)
        parts = [self.origin, self.inverse.reshape(count, 9), self.matrix.reshape(count, 9)]
        return np.concatenate(parts, axis=1)

    @property
    def vectors(self) -> np.ndarray:
        """(views, 4, 3) float64: ``origin``, ``U``, ``V``, ``D``; all that a view's image depends on."""
        return np.concatenate([self.origin[:, None], self.matrix.transpose(0, 2, 1)], axis=1)

    @cached_property
    def inverse(self) -> np.ndarray:
        """(views, 3, 3) float64 inverse of ``matrix``."""
        if self._chosen_from is not None:
            whole, indices = self._chosen_from
            return whole.inverse[indices]
        return np.linalg.inv(self.matrix)

    def ray_lengths(
        self, device: torch.device | str, dtype: torch.dtype, vectors: torch.Tensor | None = None
    ) -> torch.Tensor:
        """(views, rows, columns) length of the unnormalised ray vector of every pixel.

        It is the factor of the line integral that depends on the pixel alone (one value a view when parallel).
        ``vectors`` stand for those of the views, so that it can be differentiated by them.
        """
        if vectors is None:
            if self.cone and torch.device(device).type == "cpu" and dtype == torch.float32:
                return torch.from_numpy(self._squared_lengths()).sqrt_()
            vectors = torch.from_numpy(self.vectors)
        matrix = vectors[:, 1:].transpose(1, 2).to(device=device, dtype=dtype)
        if not self.cone:
            return matrix[:, :, 2].norm(dim=1)[:, None, None].expand(-1, self.rows, self.columns)
        column = torch.arange(self.columns, device=device, dtype=dtype)
        row = torch.arange(self.rows, device=device, dtype=dtype)
        u, v, d = (matrix[:, :, None, None, k] for k in range(3))
        ray = d + row[:, None] * v + column * u
        return ray.square().sum(dim=1).sqrt()

    def _squared_lengths(self) -> np.ndarray:
        """Squares of a cone's in float32 by numpy, to the bit: of few pixels torch takes several times as long."""
        matrix = self.matrix.astype(np.float32)
        column, row = (
            np.arange(self.columns, dtype=np.float32),
            np.arange(self.rows, dtype=np.float32)[:, None],
        )
        squares = np.zeros((len(self), self.rows, self.columns), np.float32)
        for axis in range(3):
            u, v, d = (matrix[:, axis, k, None, None] for k in range(3))
            ray = d + row * v
            squares += np.square(ray + column * u)
        return squares


def length_gradient(slope: torch.Tensor, views: DetectorViews) -> torch.Tensor:
    """What the length of each pixel's ray, a factor of its line integral, adds to dL/d(vectors), (views, 4, 3) float64.

    Parameters
    ----------
    slope : (views, rows, columns) tensor
        dL/dP times P, summed over channels, for line integrals P.
    """
    vectors = torch.from_numpy(views.vectors).to(slope.device).requires_grad_()
    with torch.enable_grad():
        logarithms = views.ray_lengths(slope.device, torch.float64, vectors).log()
    return torch.autograd.grad(logarithms, vectors, slope.double())[0]

"""The box of voxels that a reconstruction fills."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_shape

__all__ = ["VolumeGrid", "require_count"]


def require_count(argument: str, value: object) -> int:
    """A positive whole number (a float such as 64.0 is accepted), as an int."""
    number = float(require_array(argument, value, ndim=0))
    if not (np.isfinite(number) and number >= 1 and number == int(number)):
        raise fail(argument, "a positive whole number", f"{number:g}")
    return int(number)


@dataclass(frozen=True, eq=False)
class VolumeGrid:
    """Voxels ``(z, y, x)`` in an axis-aligned window; y ascends with the index.

    Parameters
    ----------
    shape : (nz, ny, nx)
        Numbers of voxels.
    lower, upper : (3,) float64
        Corners ``(x, y, z)`` of the window, in the unit of length of the scan. They are outer faces of
        voxels: voxel ``ix`` is centred at ``lower[0] + (ix + 0.5) * voxel_size[0]``.

    Raises
    ------
    ValueError
        If a count is not a positive whole number or the window is not finite, or empty, or inverted.
    """

    shape: tuple[int, int, int]
    lower: np.ndarray
    upper: np.ndarray

    def __post_init__(self) -> None:
        counts = require_array("volume shape", self.shape, ndim=1)
        require_shape("volume shape", counts, (3,), "(nz, ny, nx)")
        shape = tuple(require_count("volume shape", n) for n in counts)
        lower = np.array(require_array("volume window minimum", self.lower), dtype=np.float64)
        upper = np.array(require_array("volume window maximum", self.upper), dtype=np.float64)
        for name, corner in (("minimum", lower), ("maximum", upper)):
            require_shape(f"volume window {name}", corner, (3,), "(x, y, z)")
        for axis, low, high in zip("XYZ", lower, upper):
            if not (np.isfinite([low, high]).all() and high > low):
                raise fail(
                    f"WindowMin{axis}, WindowMax{axis}",
                    "finite with minimum < maximum",
                    f"{low:g}, {high:g}",
                    "create_vol_geom takes (rows, columns, slices, min_x, max_x, min_y, max_y, min_z, max_z)",
                )
        for name, value in (("shape", shape), ("lower", lower), ("upper", upper)):
            object.__setattr__(self, name, value)

    @property
    def extent(self) -> np.ndarray:
        """Size ``(x, y, z)`` of the window."""
        return self.upper - self.lower

    @property
    def voxel_size(self) -> np.ndarray:
        """Size ``(x, y, z)`` of one voxel."""
        return self.extent / np.array(self.shape[::-1], dtype=np.float64)

    @property
    def centre(self) -> np.ndarray:
        """Centre ``(x, y, z)`` of the window."""
        return 0.5 * (self.lower + self.upper)

    @property
    def planar(self) -> bool:
        """True for a single slice."""
        return self.shape[0] == 1

    def axes(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Coordinates of the voxel centres along x, y and z (in that order)."""
        size = self.voxel_size
        x, y, z = (self.lower[k] + (np.arange(self.shape[2 - k]) + 0.5) * size[k] for k in range(3))
        return x, y, z

    def box(self, within: Sequence[slice]) -> VolumeGrid:
        """The voxels of these slices of z, y and x, each with a first and a last one of its own."""
        first, last = np.array([(one.start, one.stop) for one in within][::-1]).T
        at_end = last == np.array(self.shape[::-1])
        upper = np.where(at_end, self.upper, self.lower + last * self.voxel_size)
        nx, ny, nz = last - first
        return VolumeGrid((nz, ny, nx), self.lower + first * self.voxel_size, upper)

    def shifted(self, by: np.ndarray) -> VolumeGrid:
        """The same voxels with the window moved by the vector ``by``."""
        by = np.asarray(by, dtype=np.float64)
        return VolumeGrid(self.shape, self.lower + by, self.upper + by)

    def scaled(self, factor: float) -> VolumeGrid:
        """The same voxels in another unit of length: every coordinate times ``factor``."""
        return VolumeGrid(self.shape, self.lower * factor, self.upper * factor)

    def normalised(self, centre: np.ndarray, length: float) -> VolumeGrid:
        """The same voxels in the coordinates ``(x - centre) / length``."""
        return self.shifted(-np.asarray(centre, dtype=np.float64)).scaled(1.0 / length)

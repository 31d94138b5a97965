"""Where in a volume the rays meet that a result does not explain."""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.scan.geometry import Geometry, VolumeGrid

__all__ = ["MisfitMap"]

# Points along the longest edge; few, for a residual says next to nothing of where along its ray it came from.
_POINTS = 32


class MisfitMap:
    """Mean squared residual of the rays through each of a few points of the volume.

    An unfiltered backprojection of what is not explained: high where rays that miss meet. It is blurred as such, and
    tells a place, not a shape.

    Parameters
    ----------
    geometry : Geometry
        Of the views that `add` gets.
    grid : VolumeGrid
    """

    def __init__(self, geometry: Geometry, grid: VolumeGrid) -> None:
        size = grid.upper - grid.lower
        longest = size.max()
        # A slice has one point along z; every axis at most as many as voxels.
        counts = np.maximum(1, np.minimum(grid.shape[::-1], np.round(_POINTS * size / longest)).astype(int))
        axes = [low + (np.arange(n) + 0.5) * s / n for low, s, n in zip(grid.lower, size, counts)]
        self.axes, self.shape = axes, tuple(counts[::-1])
        z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
        self._points = np.stack([x.ravel(), y.ravel(), z.ravel()], axis=1)
        self._geometry = geometry
        self._sum, self._seen = np.zeros(len(self._points)), np.zeros(len(self._points))

    def add(self, views: np.ndarray, squares: torch.Tensor, good: torch.Tensor) -> None:
        """Take the squared residuals (views, rows, columns) of some views, where `good`."""
        places = self._geometry.select(views).project_points(self._points)
        for place, image, usable in zip(places, squares, good):
            inside = np.isfinite(place).all(axis=1)
            column, row = np.where(inside[:, None], place, -1).round().astype(int).T
            inside &= (row >= 0) & (row < image.shape[0]) & (column >= 0) & (column < image.shape[1])
            # Only what lies at the points comes from a GPU.
            pixel = torch.from_numpy(row[inside] * image.shape[1] + column[inside]).to(image.device)
            seen = usable.flatten()[pixel].cpu().numpy()
            self._sum[inside] += np.where(seen, image.flatten()[pixel].cpu().numpy(), 0.0)
            self._seen[inside] += seen

    def values(self) -> np.ndarray:
        """(z, y, x) root mean square residual of the rays through each point; 0 where less than half see it."""
        enough = self._seen > 0.5 * self._seen.max(initial=0.0)
        mean = np.divide(self._sum, self._seen, out=np.zeros_like(self._sum), where=enough)
        return np.sqrt(mean).reshape(self.shape)

    def worst(self) -> tuple[np.ndarray, float, float]:
        """(x, y, z) of the worst point, its value, and the median of all that are seen."""
        values = self.values()
        index = np.unravel_index(int(values.argmax()), self.shape)
        place = np.array([axis[k] for axis, k in zip(self.axes, index[::-1])])
        seen = values[values > 0]
        return place, float(values[index]), float(np.median(seen)) if seen.size else 0.0

"""Part of the projections of an HDF5 file: what is not wanted is not read."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.circular import volume_seen
from tomo_polysplat.scan.dxchange_host import read_block
from tomo_polysplat.scan.geometry import geometry_from_astra, geometry_to_astra, grid_from_astra
from tomo_polysplat.scan.layout import volume_geometry
from tomo_polysplat.scan.readers.part import Part

if TYPE_CHECKING:
    from tomo_polysplat.scan.hdf5_array import StoredArray

__all__ = ["StoredPart", "part_of_geometry"]


class StoredPart:
    """Chosen views, rows and columns of a dataset (views, rows, columns).

    Parameters
    ----------
    data : StoredArray
    part : Part
        Without binning.

    Attributes
    ----------
    shape, whole_shape : (views, rows, columns)
        Of what is read, and of the dataset.
    """

    def __init__(self, data: StoredArray, part: Part) -> None:
        self._data, self.part, self.whole_shape = data, part, data.shape
        self._views = part.chosen_views(data.shape[0])
        self._spans = part.row_span(data.shape[1]), part.column_span(data.shape[2])
        high, wide = (end - first for first, end in self._spans)
        self.shape = (len(self._views), high, wide)

    def block(self, chosen: slice) -> np.ndarray:
        """Some of the views that are wanted."""
        if self.part.whole:
            return read_block(self._data, chosen)
        views = self._views[chosen]
        step = int(views[1] - views[0]) if len(views) > 1 else 1
        rows, columns = (slice(*span) for span in self._spans)
        return self._data[int(views[0]) : int(views[-1]) + 1 : step, rows, columns]

    def of_views(self, values: np.ndarray) -> np.ndarray:
        """Of one value for each view of the dataset, those of the wanted ones."""
        return values[self._views]

    def of_pixels(self, values: np.ndarray) -> np.ndarray:
        """The same of pixels, (..., rows, columns)."""
        rows, columns = (slice(*span) for span in self._spans)
        return values[..., rows, columns]

    def filters(self, known: tuple[Any, ...] | None) -> tuple[Any, ...] | None:
        """`Scan.filter_map` of the part, of that of the whole."""
        if known is None or self.part.whole:
            return known
        material, thickness, *density = known
        whole = self._data.shape[1:]
        if np.shape(thickness) not in (whole, whole[1:], (1, whole[1])):
            raise fail("filter_thickness", f"shape {whole}, (rows, columns)", f"{np.shape(thickness)}")
        return material, np.array(self.of_pixels(np.broadcast_to(thickness, whole))), *density

    def geometries(
        self, known: dict[str, Any], asked: Mapping[str, Any] | None
    ) -> tuple[dict[str, Any], bool]:
        """Those of the part, of ``proj_geom`` and ``vol_geom`` of the whole; whether the volume is still the same.

        `asked` is as of `part_of_geometry`.
        """
        if self.part.whole:
            return known, True
        whole = known["proj_geom"], known["vol_geom"]
        proj_geom, seen = part_of_geometry(self.part, *whole, self._spans, asked)
        return known | {"proj_geom": proj_geom} | ({} if seen is None else {"vol_geom": seen}), seen is None


def part_of_geometry(
    part: Part,
    proj_geom: dict[str, Any],
    vol_geom: dict[str, Any],
    spans: tuple[tuple[int, int], tuple[int, int]],
    asked: Mapping[str, Any] | None,
) -> tuple[dict[str, Any], dict[str, Any] | None]:
    """ASTRA's geometries of a part; None for that of the volume where views are all that is left out.

    The volume is the one `asked` for, if any, else what the part sees. One that is not about the z axis stays where it
    is, as high as the part sees.
    """
    seen = part.of(geometry_from_astra(proj_geom), spans)
    chosen = geometry_to_astra(seen)
    if (part.rows, part.columns, part.binning) == (None, None, 1):
        return chosen, None
    if asked is not None:
        return chosen, dict(asked)
    usual, whole = volume_seen(seen), grid_from_astra(vol_geom)
    if np.abs(whole.lower + whole.upper)[:2].max() < 2 * whole.voxel_size[:2].max():
        return chosen, usual
    lower, upper = whole.lower.copy(), whole.upper.copy()
    high = grid_from_astra(usual)
    lower[2], upper[2] = max(lower[2], high.lower[2]), min(upper[2], high.upper[2])
    size = whole.voxel_size * part.binning
    nx, ny, nz = np.maximum(1, np.round((upper - lower) / size)).astype(int)
    return chosen, volume_geometry(np.array([nz, ny, nx]), np.stack([lower, upper], axis=1).reshape(-1))

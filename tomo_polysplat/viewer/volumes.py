"""What the page shows: volumes in half precision, slice by slice, and what is told beside them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_shape, visible
from tomo_polysplat.report.slices import display_window, planes_through
from tomo_polysplat.result.data import ResultData

__all__ = ["Shown", "shown_of"]

# Half precision tells values to 1 in 2048 whatever their size, if they lie well within its range: the largest voxel
# is brought to this.
_TOP = 1000.0
_SLAB = 1 << 24


@dataclass
class Shown:
    """Volumes of one shape, and the page's words about them.

    Attributes
    ----------
    volumes : mapping of name to float16 array (z, y, x)
        Attenuation times `scale`.
    scale : float
    voxel_size : (3,) array
        Along x, y, z.
    unit : str
        Of length.
    window : pair of float
        Attenuation that is black, and white, to begin with.
    point : (3,) list
        Voxel (z, y, x) that the slices go through to begin with.
    title : str
    html : str
        What stands below the slices.
    """

    volumes: dict[str, np.ndarray]
    scale: float
    voxel_size: np.ndarray
    unit: str
    window: tuple[float, float]
    point: list[int]
    title: str
    html: str = ""
    ranges: tuple[float, float] = field(init=False)

    def __post_init__(self) -> None:
        ends = [(float(v.min()), float(v.max())) for v in self.volumes.values()]
        self.ranges = min(low for low, _ in ends) / self.scale, max(high for _, high in ends) / self.scale

    @property
    def shape(self) -> tuple[int, ...]:
        """Voxels (z, y, x)."""
        return next(iter(self.volumes.values())).shape

    def about(self) -> dict[str, Any]:
        """What the page has to know, as JSON takes it."""
        return {
            "names": [visible(name) for name in self.volumes],
            "shape": list(self.shape),
            "voxel": [float(edge) for edge in self.voxel_size[::-1]],
            "unit": self.unit,
            "scale": self.scale,
            "window": list(self.window),
            "range": list(self.ranges),
            "point": self.point,
        }

    def slice(self, volume: int, axis: int, index: int) -> bytes:
        """One slice in half precision, little-endian, row by row from the first."""
        values = list(self.volumes.values())[volume]
        return np.ascontiguousarray(values.take(index, axis), dtype="<f2").tobytes()


def shown_of(
    result: ResultData, others: Mapping[str, ResultData | np.ndarray], title: str, html: str = ""
) -> Shown:
    """From a result and what stands beside it.

    Parameters
    ----------
    result : Result
        The first volume; the page is about it.
    others : mapping of names to results or arrays (z, y, x)
        Volumes of the same shape.
    title, html : str
        See `Shown`.

    Raises
    ------
    ValueError
        For a volume of another shape, or a result in another unit.
    """
    arrays = {"tomo-polysplat": _spatial(result.volume)}
    for name, other in others.items():
        if isinstance(other, ResultData) and other.unit != result.unit:
            raise fail(name, f"a volume in 1/{result.unit}", f"1/{other.unit}")
        values = _spatial(other.volume if isinstance(other, ResultData) else other)
        require_shape(name, values, arrays["tomo-polysplat"].shape, "of the first volume")
        arrays[name] = values
    first = arrays["tomo-polysplat"]
    largest = max(float(np.abs(values).max(initial=0.0)) for values in arrays.values())
    scale = _TOP / largest if np.isfinite(largest) and largest > 0 else 1.0
    point = [plane.index for plane in planes_through(first)] if first.shape[0] > 1 else [0, 0, 0]
    if first.shape[0] == 1:
        point = [0, first.shape[1] // 2, first.shape[2] // 2]
    halves = {name: _halved(values, scale) for name, values in arrays.items()}
    return Shown(
        halves, scale, result.grid.voxel_size, result.unit, display_window(first), point, title, html
    )


def _spatial(volume: np.ndarray) -> np.ndarray:
    """(z, y, x) with y ascending."""
    volume = np.asarray(volume)
    return volume[None, ::-1] if volume.ndim == 2 else volume


def _halved(volume: np.ndarray, scale: float) -> np.ndarray:
    """In half precision, some slices at a time, for a whole volume may be large."""
    half = np.empty(volume.shape, np.float16)
    many = max(1, _SLAB // max(1, volume[0].size))
    for first in range(0, len(volume), many):
        half[first : first + many] = np.nan_to_num(volume[first : first + many]) * np.float32(scale)
    return half

"""Which slices of a volume to show, and with which grey values."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Plane", "display_window", "planes_through"]

# Share of the brightest voxels that does not count: metal nobody marked would otherwise set the scale.
SATURATED_SHARE = 0.002
# Of the main matter's attenuation: brighter than bone in tissue, darker than any metal. And voxels along an edge
# that are looked at, at most.
_FAR_BRIGHTER, _MOST = 6.0, 160


@dataclass(frozen=True)
class Plane:
    """One orthogonal slice: ``volume.take(index, axis)``, shown with the first axis upwards."""

    name: str
    axis: int
    index: int

    def of(self, volume: np.ndarray) -> np.ndarray:
        """The slice of a volume of shape (z, y, x)."""
        return volume.take(self.index, self.axis)


def planes_through(weight: np.ndarray) -> list[Plane]:
    """Orthogonal planes through most of `weight` (z, y, x), such as a metal mask; one for a single slice.

    Without any weight they go through the middle.
    """
    planes = []
    for axis, name in ((0, "axial"), (1, "coronal"), (2, "sagittal")):
        profile = np.clip(weight, 0, None).sum(axis=tuple(a for a in range(3) if a != axis), dtype=np.float64)
        index = int(profile.argmax()) if profile.any() else weight.shape[axis] // 2
        planes.append(Plane(name, axis, index))
    return planes[:1] if weight.shape[0] == 1 else planes


def display_window(volume: np.ndarray, metal_mask: np.ndarray | None = None) -> tuple[float, float]:
    """Grey values that show the bulk of an object: from 0 to three times its median.

    The median is over the voxels, metal left out, that are above a twentieth of the brightest. Denser parts
    may be shown saturated: otherwise what streaks do to the rest would be too dark to see. Where nobody has marked
    the metal, it is what is far brighter than the main matter.
    """
    if metal_mask is None:
        volume = volume[tuple(slice(None, None, max(1, n // _MOST)) for n in volume.shape)]
        metal_mask = _bright(volume)
    values = volume[~metal_mask]
    brightest = float(np.quantile(values, 1 - SATURATED_SHARE)) if values.size else 0.0
    if not brightest > 0:
        return 0.0, 1.0
    return 0.0, min(1.1 * brightest, 3 * float(np.median(values[values > 0.05 * brightest])))


def _bright(volume: np.ndarray) -> np.ndarray:
    """Voxels far brighter than the main matter."""
    from tomo_polysplat.start.levels import main_level

    level = main_level(np.nan_to_num(volume, nan=0.0, posinf=0.0, neginf=0.0))
    return volume > _FAR_BRIGHTER * level if level > 0 else np.zeros(volume.shape, bool)

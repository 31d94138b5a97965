"""Whether an object hardens the beam as a solid of its density does, or as light matter: lengths may be too short.

Rays tell areal densities alone, so that an object of water looks like one of metal where its lengths are told ten times
too short. But metal hardens the beam and water hardly does. Line integrals that are undone by the right matter make the
inside of one piece even; undone by too light a matter it is darker in the middle than at its rim, by too dense a one
brighter.
"""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.start.levels import mass_level

__all__ = ["coarse", "hardening_of"]

# Means of so many voxels that this many are left along the longest edge.
_MOST_VOXELS = 96
# Voxels of one matter are within these shares of the level of half of its mass; inside is what has more than the third.
_ALIKE, _INSIDE = (0.6, 1.6), 0.5
# Share of the slices about the middle, where a cone's rays lie in their planes.
_MIDDLE = 0.5
# Depths that are told apart, and the fewest voxels in each.
_DEPTHS, _FEWEST = 6, 10
# A solid must bend the level over the depth by this share of it (rms), to be told from light matter.
_BENT = 0.008


def coarse(volume: torch.Tensor) -> np.ndarray:
    """The slices about the middle, as means of a few voxels an axis, on the host."""
    slices = volume.shape[0]
    edge = int(0.5 * (1 - _MIDDLE) * slices)
    middle = volume[edge : slices - edge]
    step = -(-max(volume.shape) // _MOST_VOXELS)
    if step > 1:
        steps = [min(step, size) for size in middle.shape]
        middle = torch.nn.functional.avg_pool3d(middle[None, None].float(), steps)[0, 0]
    return middle.float().cpu().numpy()


def hardening_of(light: np.ndarray, dense: np.ndarray) -> float | None:
    """How an object of one solid hardens the beam: 1 as such a solid, 0 as water; None where it does not show.

    It is what the level over the depth below the surface is bent by in the first volume, relative to what it would be
    bent by in the second one, were it even in the first. An object that is uneven by itself has any number but 0.

    Parameters
    ----------
    light, dense : (nz, ny, nx) array
        What is `coarse` of its volumes, of rays undone as if it were water, and as if a solid of its density.
    """
    level = mass_level(dense)
    if not level > 0:
        return None
    inside, depth = _piece(dense, level)
    if len(depth) < _DEPTHS * _FEWEST:
        return None
    edges = np.quantile(depth, np.linspace(0, 1, _DEPTHS + 1)[1:-1])
    place = np.searchsorted(edges, depth, side="right")
    if np.bincount(place, minlength=_DEPTHS).min() < _FEWEST:
        return None
    of_light, of_dense = (_over_depth(volume[inside], place) for volume in (light, dense))
    bent = float((of_dense - of_light).std())
    return float(of_light.std()) / bent if bent > _BENT else None


def _piece(volume: np.ndarray, level: float) -> tuple[np.ndarray, np.ndarray]:
    """Where the main matter is, but for its edges, and how deep each of these voxels lies below the surface.

    In the plane of its slice, as a piece may reach through all of them.
    """
    from scipy.ndimage import binary_erosion, binary_fill_holes, distance_transform_edt

    alike = (volume > _ALIKE[0] * level) & (volume < _ALIKE[1] * level)
    inside = binary_erosion(alike, np.ones((1, 3, 3), bool))
    whole = np.stack([binary_fill_holes(plane) for plane in volume > _INSIDE * level])
    depth = np.stack([distance_transform_edt(plane) for plane in whole])
    return inside, depth[inside]


def _over_depth(values: np.ndarray, place: np.ndarray) -> np.ndarray:
    """Mean level at each depth, in medians of all."""
    sums = np.bincount(place, weights=values, minlength=_DEPTHS)
    return sums / np.bincount(place, minlength=_DEPTHS) / float(np.median(values))

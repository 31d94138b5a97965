"""Errors that a PSNR hides: bias of soft matter and of metal, and how sharp the metal's edge comes out.

Which voxels are which is read off the truth: a plateau is where the neighbours hold the same value.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from tomo_polysplat.result.metrics import compare, ssim
from tomo_polysplat.scan.scan import Scan

__all__ = ["Regions", "accuracy_errors", "edge_width"]

# Relative difference of true values that are the same material.
_SAME = 2e-3
# Voxels from metal at which soft matter is judged, and around metal that its mass is counted in.
_AWAY, _AROUND = 4.0, 2.0
# Voxels inside and outside of the metal's surface that its profile covers, and how wide a step of it is.
_INSIDE, _OUTSIDE, _STEP = 3.0, 5.0, 0.5
# Fewer voxels than this have no mean worth telling.
_FEWEST = 20


@dataclass(frozen=True, eq=False)
class Regions:
    """Voxels of a true volume that figures are taken from.

    Attributes
    ----------
    soft : (z, y, x) bool
        The most common plateau (of all 26 neighbours) 4 voxels and more from metal.
    soft_value : float
        Its true attenuation; NaN without one.
    core : (z, y, x) bool
        Metal, the six nearest neighbours of which are the same metal.
    around : (z, y, x) bool
        Metal and 2 voxels around it.
    distance : (z, y, x) float32
        Voxels from the metal's surface, which runs half a voxel outside of the last voxel that is more than
        half metal; negative inside.
    """

    soft: np.ndarray
    soft_value: float
    core: np.ndarray
    around: np.ndarray
    distance: np.ndarray

    @classmethod
    def of(cls, truth: np.ndarray, metal_mask: np.ndarray | None) -> Regions:
        """Those of a truth (z, y, x) and of the voxels that hold any metal."""
        from scipy.ndimage import generate_binary_structure

        metal = np.zeros(truth.shape, bool) if metal_mask is None else np.asarray(metal_mask, bool)
        distance, apart = _distances(truth, metal)
        soft, value = _plateau(
            truth, _flat(truth, generate_binary_structure(3, 3)) & (truth > 0) & (apart >= _AWAY)
        )
        # Pieces of metal are often a few voxels thick: the six nearest neighbours have to do.
        core = metal & _flat(truth, generate_binary_structure(3, 1))
        return cls(soft, value, core, apart <= _AROUND, distance)

    def errors(self, volume: np.ndarray, truth: np.ndarray) -> dict[str, float | None]:
        """Figures of a volume; None where the truth has too few voxels of a kind.

        Returns
        -------
        dict
            ``soft_bias`` and ``metal_bias`` (percent of the true mean), ``metal_mass`` (error of the sum over
            metal and its surroundings, percent of the true sum), ``edge_width`` and ``edge_width_true``
            (voxels, see `edge_width`).
        """
        return {
            "soft_bias": _bias(volume, truth, self.soft),
            "metal_bias": _bias(volume, truth, self.core),
            "metal_mass": _bias(volume, truth, self.around),
            "edge_width": edge_width(volume, self.distance),
            "edge_width_true": edge_width(truth, self.distance),
        }


def accuracy_errors(regions: Regions, volume: np.ndarray, scan: Scan) -> dict[str, Any]:
    """The errors of `compare`, ``ssim_all`` with the metal in it, and those of the regions."""
    assert scan.truth is not None
    return {
        **compare(volume, scan.truth, scan.metal_mask),
        "ssim_all": ssim(volume, scan.truth, float(scan.truth.max())),
        **regions.errors(volume, scan.truth),
    }


def _distances(truth: np.ndarray, metal: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Signed distance from the metal's surface and distance from voxels of metal; infinite where both are far."""
    from scipy.ndimage import distance_transform_edt, find_objects

    signed, apart = (np.full(truth.shape, np.inf, np.float32) for _ in range(2))
    boxes = find_objects(metal.astype(np.int8))
    if boxes:
        margin = math.ceil(max(_OUTSIDE + 0.5, _AWAY)) + 1
        near = tuple(slice(max(s.start - margin, 0), s.stop + margin) for s in boxes[0])
        solid = truth[near] > 0.5 * truth[metal].max()
        outside = distance_transform_edt(~solid) - 0.5
        signed[near] = np.where(solid, 0.5 - distance_transform_edt(solid), outside)
        apart[near] = distance_transform_edt(~metal[near])
    return signed, apart


def _flat(truth: np.ndarray, neighbours: np.ndarray) -> np.ndarray:
    """Voxels whose neighbours hold what they hold."""
    from scipy.ndimage import maximum_filter, minimum_filter

    # A full cube is done axis by axis, which is many times as quick.
    window: dict[str, Any] = {"size": neighbours.shape} if neighbours.all() else {"footprint": neighbours}
    highest, lowest = (found(truth, **window) for found in (maximum_filter, minimum_filter))
    return highest - lowest <= _SAME * truth


def _plateau(truth: np.ndarray, candidates: np.ndarray) -> tuple[np.ndarray, float]:
    """The voxels of the most common value among the candidates, and that value."""
    values = np.log(truth[candidates])
    if len(values) < _FEWEST:
        return np.zeros(truth.shape, bool), float("nan")
    bins = np.round(values / _SAME).astype(np.int64)
    numbers, counts = np.unique(bins, return_counts=True)
    value = float(np.exp(np.median(values[bins == numbers[counts.argmax()]])))
    return candidates & (np.abs(truth - value) <= _SAME * value), value


def _bias(volume: np.ndarray, truth: np.ndarray, chosen: np.ndarray) -> float | None:
    if np.count_nonzero(chosen) < _FEWEST:
        return None
    true = float(truth[chosen].mean(dtype=np.float64))
    return 100.0 * (float(volume[chosen].mean(dtype=np.float64)) / true - 1.0)


def edge_width(volume: np.ndarray, distance: np.ndarray) -> float | None:
    """Width in voxels of the mean profile across the metal's surface, between 90 and 10 % of its own height.

    The profile is the mean over steps of half a voxel of the signed distance, from 3 voxels inside, or the
    deepest there are, to 5 outside; 100 % is its deepest step and 0 % its mean beyond 3 voxels outside. Even a
    true volume has a width, since voxels at a surface hold a part of either side.

    Parameters
    ----------
    volume : (z, y, x) array
    distance : (z, y, x) array
        Signed distance in voxels, negative inside.

    Returns
    -------
    float or None
        None without metal, or where the profile does not fall from 90 to 10 % within its range.
    """
    near = (distance >= -_INSIDE) & (distance <= _OUTSIDE)
    steps = np.floor(distance[near] / _STEP).astype(np.int64)
    if not len(steps) or steps.min() >= 0:
        return None
    steps -= steps.min()
    counts = np.bincount(steps)
    filled = counts > 0
    place, value = (
        np.bincount(steps, weights=part[near].astype(np.float64))[filled] / counts[filled]
        for part in (distance, volume)
    )
    far = place > 3.0
    height = value[0] - value[far].mean() if far.any() else 0.0
    if height <= 0:
        return None
    relative = (value - value[far].mean()) / height
    high, low = _falls_below(place, relative, 0.9), _falls_below(place, relative, 0.1)
    return None if high is None or low is None else low - high


def _falls_below(place: np.ndarray, value: np.ndarray, level: float) -> float | None:
    """Where a profile first falls below a level, between its points."""
    below = np.flatnonzero(value < level)
    if not len(below):
        return None
    last = int(below[0])
    share = (value[last - 1] - level) / (value[last - 1] - value[last])
    return float(place[last - 1] + share * (place[last] - place[last - 1]))

"""Rays that pass more or less of a filter before the object; P counts from the open beam behind it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomo_polysplat.physics.beer_lambert import projection, shares
from tomo_polysplat.physics.ray_range import MaxPath, span_rays

__all__ = ["Behind", "FilteredRays", "filtered_rays"]

# A filter: material, least and largest areal density in g/cm2.
Behind = tuple[str, float, float]


@dataclass(frozen=True, eq=False)
class FilteredRays:
    """Rays through an object and a filter.

    Attributes
    ----------
    areal : (k + 1, rays) array
        Areal densities in g/cm2 of the object's materials, and last of the filter.
    bare : (k + 1, f) array
        Each areal density of the filter, without an object.
    level : (rays,) int array
        Which of them a ray passes.
    """

    areal: np.ndarray
    bare: np.ndarray
    level: np.ndarray

    def seen(self, log_weights: np.ndarray, attenuation: np.ndarray) -> np.ndarray:
        """(rays,) P relative to the open beam behind the filter."""
        nodes = (log_weights, attenuation)
        return projection(self.areal, *nodes) - projection(self.bare, *nodes)[self.level]

    def slopes(self, log_weights: np.ndarray, attenuation: np.ndarray) -> np.ndarray:
        """(f, k) dP by areal density of each of the object's materials, without an object."""
        share = shares(self.bare, log_weights, attenuation)[1]
        return np.einsum("nf,kn->fk", share, attenuation[:-1])


def filtered_rays(
    nodes: tuple[np.ndarray, np.ndarray],
    max_path: MaxPath,
    behind: Behind,
    filters: int,
    divisions: int,
    levels: np.ndarray,
) -> FilteredRays:
    """Rays that span the range of a scan behind so many areal densities of a filter.

    Parameters
    ----------
    nodes : (n,) and (k + 1, n) arrays
        Log weights and attenuation of the full spectrum; the last curve is the filter's.
    max_path, divisions, levels
        As `span_rays` takes them, behind each areal density.
    behind : (material, least, largest)
    filters : int
    """
    log_weights, attenuation = nodes
    # Dense near the least, where the softest photons go first.
    places = behind[1] + (behind[2] - behind[1]) * np.linspace(0.0, 1.0, filters) ** 2
    objects = len(attenuation) - 1
    parts = []
    for areal in places:
        passed = log_weights - areal * attenuation[-1]
        passed = passed - np.logaddexp.reduce(passed)
        rays = span_rays(passed, attenuation[:-1], max_path, divisions, levels)
        rays = np.concatenate([np.zeros((objects, 1)), rays], axis=1)
        parts.append(np.pad(rays, ((0, 1), (0, 0)), constant_values=areal))
    level = np.repeat(np.arange(filters), [part.shape[1] for part in parts])
    bare = np.pad(places[None], ((objects, 0), (0, 0)))
    return FilteredRays(np.concatenate(parts, axis=1), bare, level)

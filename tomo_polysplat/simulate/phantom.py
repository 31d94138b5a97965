"""Phantoms: solids of known material and density, the later ones replacing the earlier where they overlap."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_number, require_shape
from tomo_polysplat.simulate.chords import trace_rays
from tomo_polysplat.simulate.shapes import Shape

__all__ = ["Part", "Phantom"]


@dataclass(frozen=True)
class Part:
    """One solid of a phantom.

    Attributes
    ----------
    shape : Shape
    material : str
        A name or formula that ``tomo_polysplat.physics.materials`` knows.
    density : float
        In g/cm3; 0 makes a hole.
    metal : bool
        Whether it belongs to the metal that a scene can be had without.
    """

    shape: Shape
    material: str
    density: float
    metal: bool = False


@dataclass(frozen=True)
class Phantom:
    """Parts in order of precedence: where parts overlap, the last of them is what is there.

    Attributes
    ----------
    parts : tuple of Part
    materials : tuple of str
        The distinct materials, in order of first use; the last axis of :meth:`areal_density`.
    """

    parts: tuple[Part, ...]
    materials: tuple[str, ...] = field(init=False)

    def __init__(self, parts: Iterable[Part]) -> None:
        kept = tuple(parts)
        if not kept:
            raise fail("parts", "at least one part", "none")
        for part in kept:
            require_number(f"density of {part.material}", part.density, at_least=0.0)
        object.__setattr__(self, "parts", kept)
        object.__setattr__(self, "materials", tuple(dict.fromkeys(part.material for part in kept)))

    def with_metal(self, material: str | None, density: float = 0.0) -> Phantom:
        """The same phantom with its metal made of another material, or left out when ``material`` is None.

        Where metal is left out, what lies under it by precedence is there instead.
        """
        if material is None:
            return Phantom(part for part in self.parts if not part.metal)
        return Phantom(
            replace(part, material=material, density=density) if part.metal else part for part in self.parts
        )

    def solids(self) -> tuple[np.ndarray, ...]:
        """The parts as arrays, in order, in the layout of the compiled tracer."""
        shapes = [part.shape for part in self.parts]
        return (
            np.array([shape.round_axes for shape in shapes], np.int64),
            np.array([shape.centre for shape in shapes]),
            np.array([shape.to_local for shape in shapes]),
            # A tangent ray may miss the sphere by rounding; the margin keeps culling on the safe side.
            np.array([shape.radius for shape in shapes]) * (1.0 + 1e-12),
            np.array([self.materials.index(part.material) for part in self.parts], np.int64),
            np.array([part.density for part in self.parts], float),
        )

    def areal_density(
        self, origins: np.ndarray, directions: np.ndarray, start: float = -math.inf, stop: float = math.inf
    ) -> np.ndarray:
        """Areal density of each material along rays: density times visible path length, summed over parts.

        Parameters
        ----------
        origins, directions : (n, 3)
            In cm; a direction may have any length but 0.
        start, stop : float
            The part of every ray that counts, in multiples of its direction: 0 and 1 for rays that run from a
            source, their origin, to a pixel at ``origin + direction``.

        Returns
        -------
        (n, materials) float64, in g/cm2.
        """
        origins = np.ascontiguousarray(require_array("origins", origins, 2), float)
        directions = np.ascontiguousarray(require_array("directions", directions, 2), float)
        require_shape("origins", origins, (len(origins), 3), "(rays, xyz)")
        require_shape("directions", directions, origins.shape, "(rays, xyz)")
        if not (directions**2).sum(axis=1).all():
            raise fail("directions", "directions that are not zero", "a zero direction")
        out = np.zeros((len(origins), len(self.materials)))
        trace_rays(origins, directions, (float(start), float(stop)), self.solids(), out)
        return out

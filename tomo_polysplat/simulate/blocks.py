"""Building blocks that the scenes share: rounded bodies, and fine texture that is the same at every call."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.simulate.phantom import Part
from tomo_polysplat.simulate.shapes import Shape, cylinder, ellipsoid, rotation

__all__ = ["domed_cylinder", "random_turn", "strew"]


def domed_cylinder(
    radii: tuple[float, float], half_length: float, dome: float, material: str, density: float
) -> list[Part]:
    """An upright cylinder about the origin with a dome on each end; lengths in cm.

    Flat ends would add a cone-beam artefact of filtered backprojection that has nothing to do with metal.
    """
    ends = [ellipsoid((0, 0, end), (*radii, dome)) for end in (-half_length, half_length)]
    return [Part(shape, material, density) for shape in (*ends, cylinder((0, 0, 0), radii, half_length))]


def random_turn(generator: np.random.Generator) -> np.ndarray:
    """A rotation about a random axis by a random angle."""
    return rotation(generator.standard_normal(3), generator.uniform(0.0, 360.0))


def strew(
    container: Shape,
    count: int,
    material: str,
    density: tuple[float, float],
    size: tuple[float, float],
    seed: int,
) -> list[Part]:
    """Randomly turned ellipsoids that lie wholly inside a convex solid and may overlap each other.

    Parameters
    ----------
    container : Shape
    count : int
    material : str
    density, size : (lowest, highest)
        Ranges of their densities, in g/cm3, and semi-axes, in cm.
    seed : int
        Fixes the texture, which thus is part of the phantom and not of the noise.
    """
    generator = np.random.default_rng(seed)
    parts: list[Part] = []
    while len(parts) < count:
        local = generator.uniform(-1.0, 1.0, 3)
        semi = generator.uniform(*size, 3)
        # Shrinking the unit solid by the largest semi-axis keeps the ellipsoid inside whatever its turn.
        room = 1.0 - semi.max() / container.semi.min()
        centre = container.centre + container.axes @ (room * local * container.semi)
        if room > 0 and container.contains(container.centre + container.axes @ (local * container.semi)):
            shape = ellipsoid(centre, semi, random_turn(generator))
            parts.append(Part(shape, material, float(generator.uniform(*density))))
    return parts

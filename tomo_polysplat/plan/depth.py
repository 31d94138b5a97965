"""How much light an object takes away, metal apart, and what that means for smoothing."""

from __future__ import annotations

import math

import torch

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.rays import Rays

__all__ = ["optical_depth", "weights_by_depth"]

# Matter, rather than noise, is what holds more than this multiple of the level below which voxels are empty.
_MATTER = 3.0
# Optical depth of the objects that the usual smoothing was chosen on (teeth, pins, lung, pancreas: 0.9 to 1.1), and the
# share of it below which an object is thin.
_USUAL, _THIN = 0.9, 0.6


def optical_depth(relative: torch.Tensor, empty: float, reference: float, problem: Problem) -> float:
    """-log(I/I0) of a typical ray, as if nothing were denser than the soft reference.

    It is the mean over lines of voxels along x and along y, each weighed by the matter it meets: of a ball three
    quarters of what its diameter takes away.

    Parameters
    ----------
    relative : (nz, ny, nx) tensor
        The start volume in soft references.
    empty : float
        Level in soft references below which there is nothing.
    reference : float
        The soft reference, in g/cm3 or per unit of length.
    problem : Problem

    Returns
    -------
    float
        0 for a volume without matter.
    """
    matter = torch.where(relative > _MATTER * empty, relative.clamp(max=1.0), 0.0)
    per_length = reference * problem.soft_attenuation() * problem.length
    depths = []
    for axis, edge in ((2, problem.grid.voxel_size[0]), (1, problem.grid.voxel_size[1])):
        lines = matter.sum(dim=axis, dtype=torch.float64) * (float(edge) * per_length)
        depths.append(float(lines.square().sum() / lines.sum().clamp(min=1e-300)))
    return sum(depths) / len(depths)


def weights_by_depth(depth: float, rays: Rays) -> tuple[float, float]:
    """Factors of the total variation's weight for an object of that optical depth; 1 and 1 unless it is thin.

    The misfit is counted in -log(I/I0), the total variation in soft references. With a share ``c`` of the usual depth
    what the object shows is ``c`` times as large, and so are the model's errors, while photon noise is as it was.

    Returns
    -------
    (float, float)
        ``c``; and ``c`` times the deviation of both errors over that at the usual depth, which is near the best of six
        weights wherever a ray of a volume tells more than noise (docs/decisions/optical_depth.md).
    """
    share = depth / _USUAL
    if not 0 < share < _THIN:
        return 1.0, 1.0
    if math.isinf(rays.noise):
        return share, share
    return share, share * math.sqrt((rays.noise + share**2) / (rays.noise + 1))

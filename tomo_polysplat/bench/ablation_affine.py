"""The affine approximation of a Gaussian's projection (EWA) against the exact line integral.

Splatting methods made for images project a Gaussian as if the rays about its centre were parallel: the
projected covariance is ``J Sigma J^T`` with the Jacobian ``J`` of the perspective at the centre, and the height
is the line integral along the ray through the centre (Zwicker et al. 2002, doi:10.1109/TVCG.2002.1021576; for
x-rays as in R2-Gaussian, arXiv:2405.20693). That is exact for a parallel beam and worse the wider the Gaussian
and the cone.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from tomo_polysplat.kernels.project.reference import project, whitening_matrices
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["affine_errors", "project_affine"]

# Of the cone, and of the Gaussians in units of half the object's width: 1, 2 and 4 voxels of 128.
HALF_ANGLES, WIDTHS = (5.0, 11.0, 20.0, 30.0, 45.0), (1 / 64, 1 / 32, 1 / 16)
_GAUSSIANS, _PIXELS, _CUTOFF = 300, 64, 8.0


def project_affine(
    position: torch.Tensor,
    scale: torch.Tensor,
    rotation: torch.Tensor,
    weight: torch.Tensor,
    views: DetectorViews,
) -> torch.Tensor:
    """Approximate line integrals of weighted Gaussians over every pixel of a cone beam.

    Parameters
    ----------
    position, scale : (n, 3) tensor
    rotation : (n, 4) tensor
        Quaternions (w, x, y, z).
    weight : (n,) tensor
    views : DetectorViews

    Returns
    -------
    (views, rows, columns) tensor
    """
    whitening = whitening_matrices(scale, rotation)
    covariance = torch.linalg.inv(whitening.transpose(1, 2) @ whitening)
    row, column = torch.meshgrid(
        *(torch.arange(n, dtype=position.dtype) for n in (views.rows, views.columns)), indexing="ij"
    )
    images = []
    for origin, inverse in zip(views.origin, views.inverse):
        away = position - torch.as_tensor(origin, dtype=position.dtype)
        matrix = torch.as_tensor(inverse, dtype=position.dtype)
        a, b, c = (away @ matrix.T).unbind(1)
        centre = torch.stack([a / c, b / c], dim=1)
        jacobian = (matrix[None, :2] - centre[:, :, None] * matrix[2]) / c[:, None, None]
        precision = torch.linalg.inv(jacobian @ covariance @ jacobian.transpose(1, 2))
        along = torch.einsum("nij,nj->ni", whitening, away / away.norm(dim=1, keepdim=True))
        height = weight * math.sqrt(2 * math.pi) / along.norm(dim=1)
        offset = torch.stack([column, row], dim=-1).reshape(-1, 2)[None] - centre[:, None]
        square = torch.einsum("npi,nij,npj->np", offset, precision, offset)
        images.append((height[:, None] * torch.exp(-0.5 * square)).sum(dim=0).reshape(row.shape))
    return torch.stack(images)


def affine_errors(seed: int = 0) -> list[dict[str, Any]]:
    """Errors of rays through a ball of Gaussians, in percent of the exact maximum.

    The ball has radius 1 and fills the cone. Its Gaussians are drawn at random in place, direction and weight,
    with deviations between half and twice the named one along their axes.

    Returns
    -------
    list of dict
        ``half_angle_degrees``, ``width``, ``rms_percent`` (over the rays that hit the ball) and
        ``largest_percent``.
    """
    rng = np.random.default_rng(seed)
    place = rng.normal(size=(_GAUSSIANS, 3))
    place *= (rng.uniform(size=(_GAUSSIANS, 1)) ** (1 / 3)) / np.linalg.norm(place, axis=1, keepdims=True)
    spread = 2 ** rng.uniform(-1, 1, size=(_GAUSSIANS, 3))
    turn, weight = rng.normal(size=(_GAUSSIANS, 4)), rng.uniform(0.5, 1.5, size=_GAUSSIANS)
    found = []
    for angle in HALF_ANGLES:
        views = _views(angle)
        for width in WIDTHS:
            where, wide, turned, heavy = map(torch.from_numpy, (0.9 * place, width * spread, turn, weight))
            exact = project(where, wide, turned, heavy[None], views, _CUTOFF)[0][0]
            error = project_affine(where, wide, turned, heavy, views) - exact
            hit, top = exact > 1e-3 * exact.max(), float(exact.max())
            found.append(
                {
                    "half_angle_degrees": angle,
                    "width": width,
                    "rms_percent": 100 * float(error[hit].square().mean().sqrt()) / top,
                    "largest_percent": 100 * float(error.abs().max()) / top,
                }
            )
    return found


def _views(half_angle: float) -> DetectorViews:
    """One view of a flat detector through the centre, whose edges are the cone's."""
    distance = 1.0 / math.sin(math.radians(half_angle))
    half = distance * math.tan(math.radians(half_angle))
    pixel = 2 * half / _PIXELS
    edge = -half + 0.5 * pixel
    matrix = np.array([[pixel, 0.0, edge], [0.0, 0.0, distance], [0.0, pixel, edge]])
    return DetectorViews(True, np.array([[0.0, -distance, 0.0]]), matrix[None], _PIXELS, _PIXELS)

"""The projection of Gaussians in plain torch: any device, any float type, differentiable; the truth.

Every pixel-Gaussian pair is evaluated, so it is for tests and small scenes. README.md beside this file
derives the formula.
"""

from __future__ import annotations

import math
from typing import Any

import torch

from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["project", "whitening_matrices"]

_PAIRS_AT_ONCE = 1 << 22


def whitening_matrices(scale: torch.Tensor, rotation: torch.Tensor) -> torch.Tensor:
    """``W = diag(1/scale) R^T`` of shape (n, 3, 3); ``rotation`` are quaternions (w, x, y, z) of any length."""
    w, x, y, z = torch.nn.functional.normalize(rotation, dim=1).unbind(1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], 1),
        torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], 1),
        torch.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    return torch.stack(rows, 1) / scale[:, :, None]


def project(
    position: torch.Tensor,
    scale: torch.Tensor,
    rotation: torch.Tensor,
    weight: torch.Tensor,
    views: DetectorViews,
    cutoff: float,
    vectors: torch.Tensor | None = None,
) -> tuple[torch.Tensor, int]:
    """Line integrals of weighted Gaussians.

    Parameters
    ----------
    position : (n, 3) tensor
    scale : (n, 3) tensor
        Standard deviations; ``inf`` along z makes a Gaussian two-dimensional.
    rotation : (n, 4) tensor
        Quaternions (w, x, y, z), normalised here.
    weight : (channels, n) tensor
        Height of every Gaussian in every channel.
    views : DetectorViews
    cutoff : float
        A Gaussian ends at this many standard deviations.
    vectors : (views, 4, 3) float64 tensor, optional
        In the place of ``views.vectors``, for what is to be differentiated by them.

    Returns
    -------
    image : (channels, views, rows, columns) tensor
    skipped : int
        Pairs of a Gaussian and a view left out because the Gaussian reaches the source plane.
    """
    whiten = whitening_matrices(scale, rotation)
    like: dict[str, Any] = {"device": position.device, "dtype": position.dtype}
    pixels = views.rows * views.columns
    chunk = max(1, _PAIRS_AT_ONCE // pixels)
    images, skipped = [], 0
    if vectors is None:
        vectors = torch.from_numpy(views.vectors)
    for view in range(len(views)):
        one = vectors[view].to(position.device)
        image = torch.zeros((len(weight), views.rows, views.columns), **like)
        for start in range(0, max(1, len(position)), chunk):
            part = slice(start, start + chunk)
            kernel, left_out = _one_view(position[part], whiten[part], scale[part], views, one, cutoff)
            image = image + torch.einsum("kn,nij->kij", weight[:, part], kernel)
            skipped += left_out
        images.append(image)
    image = (
        torch.stack(images, 1) if images else position.new_zeros((len(weight), 0, views.rows, views.columns))
    )
    lengths = views.ray_lengths(position.device, position.dtype, vectors)
    return image * (math.sqrt(2 * math.pi) * lengths), skipped


def _one_view(
    position: torch.Tensor,
    whiten: torch.Tensor,
    scale: torch.Tensor,
    views: DetectorViews,
    vectors: torch.Tensor,
    cutoff: float,
) -> tuple[torch.Tensor, int]:
    """``exp(-distance^2 / 2) / |e|`` of shape (n, rows, columns) and the number of Gaussians left out."""
    like: dict[str, Any] = {"device": position.device, "dtype": position.dtype}
    # The inverse in float64 whatever the Gaussians are.
    inverse = torch.linalg.inv(vectors[1:].T).to(**like)
    origin, step_u, step_v, direction = vectors.to(**like)
    offset = position - origin
    local = offset @ inverse.T
    ahead = torch.ones(len(position), dtype=torch.bool, device=position.device)
    kappa = torch.ones_like(local[:, 2])
    if views.cone:
        # The cut Gaussian must lie in front of the source plane: its half-width in c = 1 / kappa is |S R^T c_row|.
        extent = (whiten @ inverse[2]) * scale.square()
        ahead = local[:, 2] > 1.001 * cutoff * extent.detach().nan_to_num(0.0).norm(dim=1)
        kappa = 1 / torch.where(ahead, local[:, 2], torch.ones_like(kappa))
    column0, row0 = local[:, 0] * kappa, local[:, 1] * kappa
    w = torch.einsum("nab,nb->na", whiten, offset if views.cone else direction.expand_as(offset))
    wu, wv = whiten @ step_u, whiten @ step_v
    nu, nv = torch.linalg.cross(w, wu), torch.linalg.cross(w, wv)
    dj = torch.arange(views.columns, **like)[None, None, :, None] - column0[:, None, None, None]
    di = torch.arange(views.rows, **like)[None, :, None, None] - row0[:, None, None, None]
    if views.planar:
        di = torch.zeros_like(di)
    distance = (dj * nu[:, None, None] + di * nv[:, None, None]).square().sum(-1)
    ray = (kappa[:, None] * w)[:, None, None]
    if views.cone:
        ray = ray + dj * wu[:, None, None] + di * wv[:, None, None]
    length2 = ray.square().sum(-1)
    inside = ahead[:, None, None] & (distance <= cutoff**2 * length2)
    length2 = torch.where(inside, length2, torch.ones_like(length2))
    distance = torch.where(inside, distance, torch.zeros_like(distance))
    value = torch.exp(-0.5 * distance / length2) / length2.sqrt()
    return torch.where(inside, value, torch.zeros_like(value)), int((~ahead).sum())

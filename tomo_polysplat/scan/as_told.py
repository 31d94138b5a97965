"""Projections as the told geometry would have seen them, for what knows no other: filtered backprojection."""

from __future__ import annotations

from collections.abc import Mapping

import torch

from tomo_polysplat.scan.moves import Scanner

__all__ = ["seen_as_told"]

# Views interpolated together.
_AT_ONCE = 16


@torch.no_grad()
def seen_as_told(
    projections: torch.Tensor, scanner: Scanner, values: Mapping[str, torch.Tensor]
) -> torch.Tensor:
    """Projections of a moved scanner, interpolated where the rays of the told one meet its detector.

    Of every told ray the point next to the pivot is looked up. While the source stays, or the direction of parallel
    rays, that is the ray itself, and nothing but the interpolation is lost; where the axis is skewed, one close by.
    Rays that the moved detector has not seen are those of its rim; those beside one that is NaN are NaN.

    Parameters
    ----------
    projections : (views, rows, columns) tensor
    scanner : Scanner
        As told.
    values : mapping of names of moves to tensors
        As `Scanner.moved` takes them.

    Returns
    -------
    (views, rows, columns) tensor, of the same type and on the same device
    """
    device, (many, rows, columns) = projections.device, projections.shape
    told, moved = scanner.moved({}), scanner.moved(values)
    column = torch.arange(columns, dtype=torch.float64, device=device)[:, None]
    row = torch.arange(rows, dtype=torch.float64, device=device)[:, None, None]
    pivot = scanner.pivot.to(device)
    seen = torch.empty_like(projections)
    # What the interpolation counts from -1 to 1 are the outer faces of the first and last pixel.
    size = torch.tensor([columns, rows], dtype=torch.float64, device=device)
    for first in range(0, many, _AT_ONCE):
        part = slice(first, first + _AT_ONCE)
        origin, corner, u, v = (t[part, None, None].to(device) for t in told)
        pixel = corner + column * u + row * v
        ray = pixel - origin if scanner.cone else origin.expand_as(pixel)
        share = ((pivot - pixel) * ray).sum(-1, keepdim=True) / ray.square().sum(-1, keepdim=True)
        matrix = moved.vectors(scanner.cone)[part].to(device)
        local = (pixel + share * ray - matrix[:, 0, None, None]) @ torch.linalg.inv(matrix[:, None, 1:])
        where = local[..., :2] / local[..., 2:] if scanner.cone else local[..., :2]
        grid = ((2 * where + 1) / size - 1).to(projections.dtype)
        seen[part] = torch.nn.functional.grid_sample(
            projections[part, None], grid, mode="bilinear", padding_mode="border", align_corners=False
        )[:, 0]
    return seen

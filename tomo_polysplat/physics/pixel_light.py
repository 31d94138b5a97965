"""Pixels average the light over their area, before the logarithm is taken."""

from __future__ import annotations

import math

import torch

__all__ = ["averaged_light"]


def averaged_light(projections: torch.Tensor, rows: int, columns: int) -> torch.Tensor:
    """-log of the mean of exp(-P) over the rays of each pixel.

    Where P varies within a pixel, as at the edge of metal, it is less than the mean of P: light passes beside the
    metal (Glover and Pelc, Medical Physics 7, 1980, 238).

    Parameters
    ----------
    projections : (views, parts * rows, parts * columns) tensor
        P of rays that are spread evenly over the pixels; as many along an axis as there are parts.
    rows, columns : int
        Of the detector.

    Returns
    -------
    (views, rows, columns) tensor
    """
    views, fine_rows, fine_columns = projections.shape
    parts = projections.reshape(views, rows, fine_rows // rows, columns, fine_columns // columns)
    number = parts.shape[2] * parts.shape[4]
    return math.log(number) - torch.logsumexp(-parts, dim=(2, 4))

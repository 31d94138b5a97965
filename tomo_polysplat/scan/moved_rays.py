"""Where the rays of a scanner that is moved a little fall on the detector as it stands."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch

from tomo_polysplat.scan.moves import Scanner
from tomo_polysplat.scan.slopes import slope_at_zero

__all__ = ["FALLS", "falls_of", "falls_on"]

# Moves of the detector alone: the rays of a moved detector are rays of one that stays, between its pixels.
FALLS = ("u", "v", "roll", "tilt", "slant", "distance")


def falls_of(scanner: Scanner, values: Mapping[str, torch.Tensor], names: Sequence[str]) -> torch.Tensor:
    """How rays shift on the detector with each move, as numbers for `falls_on`.

    A point of the moved detector is :math:`X + \\delta X`, affine in column and row. In steps of the detector and in
    the ray to its corner, :math:`\\delta X = \\alpha u + \\beta v + \\gamma (X_{00} - s)`; seen from the source, the
    last part is a shift by :math:`-\\gamma` times column and row.

    Parameters
    ----------
    scanner : Scanner
    values : mapping of names of moves to float64 tensors
        Where the scanner is.
    names : sequence of names of `FALLS`

    Returns
    -------
    (names, views, 3, 3) float64 tensor
        Of :math:`\\alpha, \\beta, \\gamma`: at the corner, and their change per column and row, by a move of one unit.
    """
    views = scanner.moved(values)
    third = views.corner - views.origin if scanner.cone else views.origin
    inverse = torch.linalg.inv(torch.stack([views.u, views.v, third], dim=2))
    found = []
    for name in names:

        def moved(step: torch.Tensor, name: str = name) -> torch.Tensor:
            told = values.get(name, torch.zeros((), dtype=torch.float64))
            parts = scanner.moved({**values, name: told + step})
            return torch.stack([parts.corner, parts.u, parts.v], dim=2)

        found.append(inverse @ slope_at_zero(moved))
    falls = torch.stack(found)
    if not scanner.cone:
        # Along a parallel beam nothing shifts.
        falls[:, :, 2] = 0.0
    return falls


def falls_on(
    falls: torch.Tensor, columns: torch.Tensor, rows: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """Shifts along columns and along rows, (names, views, rows, columns), of one unit of each move.

    Parameters
    ----------
    falls : (names, views, 3, 3) tensor
        See `falls_of`; in the precision and on the device of the result.
    columns : (columns,) tensor
        Indices of the columns.
    rows : (rows,) tensor
    """
    at_corner, by_column, by_row = (part[..., None, None] for part in falls.unbind(dim=3))
    along = at_corner + by_column * columns + by_row * rows[:, None]
    across, down, deep = along.unbind(dim=2)
    return across - deep * columns, down - deep * rows[:, None]

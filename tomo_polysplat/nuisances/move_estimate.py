"""How a scanner moved, out of what a fit leaves of the rays: Gauss and Newton's step, with its error.

A fit that has made a pass or two over the views has the object roughly, and the object takes no part in most moves. So
what is left of each view, against how its image would change, tells them in one step.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

__all__ = ["WholeMoves", "shifts_of_views", "whole_moves"]

# Groups of views of which each is left out once, for the error.
_GROUPS, _FEWEST_GROUPS = 12, 4
# Slopes that are a sum of others but for this share of their square tell nothing.
_RANK = 1e-6
# In standard errors of the variance: how sure it must be that shifts of views exceed their noise.
_SURE = 4.0


@dataclass(frozen=True)
class WholeMoves:
    """Moves of the whole scanner, and their standard errors; 0 and infinity where the rays do not tell."""

    value: np.ndarray
    error: np.ndarray

    def among(self, many: int, which: Sequence[int]) -> WholeMoves:
        """These as those of so many moves with the numbers ``which``; the rays do not tell the rest."""
        value, error = np.zeros(many), np.full(many, np.inf)
        value[list(which)], error[list(which)] = self.value, self.error
        return WholeMoves(value, error)


def whole_moves(normal: np.ndarray, told: np.ndarray, which: Sequence[int]) -> WholeMoves:
    """Moves that all views have in common, by the jackknife over groups of neighbouring views (Efron 1982).

    Parameters
    ----------
    normal : (views, n, n) array
        Sums of products of slopes; the last is that of a constant, which every view has for itself.
    told : (views, n) array
        Sums of slopes times what is left.
    which : sequence of int
        The slopes of the moves; none where nothing of the whole scanner is asked.
    """
    if not len(which):
        return WholeMoves(np.zeros(0), np.zeros(0))
    matrix, right = _without_constant(normal, told, which)
    groups = [part for part in np.array_split(np.arange(len(matrix)), _GROUPS) if len(part)]
    whole = _solved(matrix.sum(axis=0), right.sum(axis=0))
    nothing = WholeMoves(np.zeros(len(which)), np.full(len(which), np.inf))
    if whole is None or len(groups) < _FEWEST_GROUPS:
        return nothing
    without = [
        _solved(matrix.sum(axis=0) - matrix[part].sum(axis=0), right.sum(axis=0) - right[part].sum(axis=0))
        for part in groups
    ]
    told_without = [one for one in without if one is not None]
    if len(told_without) < len(groups):
        return nothing
    return WholeMoves(whole, np.sqrt((len(groups) - 1) * np.var(np.stack(told_without), axis=0)))


def shifts_of_views(normal: np.ndarray, told: np.ndarray, gauge: np.ndarray) -> np.ndarray:
    """Shifts of single views along columns and rows, shrunk by how well they are known, (views, 2).

    Both halves of the detector tell the same shift. By how much they differ is the noise. What exceeds that is believed
    (empirical Bayes: Morris 1983, doi:10.1080/01621459.1983.10477920), where it does so surely.

    Parameters
    ----------
    normal, told : (2, views, 3, 3), (2, views, 3) array
        Of the left half and the right one, by shifts along columns and along rows, and of a constant.
    gauge : (2 views, n) array
        Orthonormal shifts, (views, 2) flattened, that are none of single views (`scan.gauges.view_gauge`).
    """
    whole, (left, of_left), (right, of_right) = (
        _of_views(matrix, values)
        for matrix, values in (
            (normal.sum(axis=0), told.sum(axis=0)),
            (normal[0], told[0]),
            (normal[1], told[1]),
        )
    )
    both = _less_gauge(whole[0], gauge)
    apart = _less_gauge(left, gauge) - _less_gauge(right, gauge)
    # A half that sees less detail has more noise, and less of a part in both.
    part = of_left / np.maximum(of_left + of_right, 1e-300)
    # A view's shift has the more noise the less tells it, as in the first and the last views of a helix.
    told_by, views = whole[1], np.maximum((whole[1] > 0).sum(axis=0), 1)
    noise, size = (
        (told_by * square).sum(axis=0) / views for square in (part * (1 - part) * apart**2, both**2)
    )
    excess = size - noise
    sure = excess > _SURE * np.sqrt(2 / views) * noise
    believed = excess / np.maximum(told_by.sum(axis=0) / views, 1e-300) * told_by
    return _less_gauge(both * np.where(sure, believed / np.maximum(believed + noise, 1e-300), 0.0), gauge)


def _of_views(normal: np.ndarray, told: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(views, 2) shifts, 0 along what tells nothing, and how much tells each: the sum of its squared slopes."""
    matrix, right = _without_constant(normal, told, (0, 1))
    told_by = np.einsum("vkk->vk", matrix)
    usable = told_by > _RANK * max(float(told_by.max(initial=0.0)), 1e-300)
    # Along rows a scan of one row tells nothing.
    cross = np.where(usable.all(axis=1), matrix[:, 0, 1], 0.0)
    size, right = np.where(usable, told_by, 1.0), np.where(usable, right, 0.0)
    least = np.maximum(size[:, 0] * size[:, 1] - cross**2, _RANK * size[:, 0] * size[:, 1])
    first = size[:, 1] * right[:, 0] - cross * right[:, 1]
    second = size[:, 0] * right[:, 1] - cross * right[:, 0]
    return np.stack([first, second], axis=1) / least[:, None], np.where(usable, told_by, 0.0)


def _less_gauge(shifts: np.ndarray, gauge: np.ndarray) -> np.ndarray:
    flat = shifts.reshape(-1)
    return (flat - gauge @ (gauge.T @ flat)).reshape(shifts.shape)


def _without_constant(
    normal: np.ndarray, told: np.ndarray, which: Sequence[int]
) -> tuple[np.ndarray, np.ndarray]:
    """The equations of some slopes, with each view's constant taken out of them."""
    some = np.asarray(which)
    between = normal[:, some, -1]
    count = np.maximum(normal[:, -1, -1], 1e-300)
    matrix = normal[:, some[:, None], some] - between[:, :, None] * between[:, None] / count[:, None, None]
    return matrix, told[:, some] - between * (told[:, -1] / count)[:, None]


def _solved(matrix: np.ndarray, right: np.ndarray) -> np.ndarray | None:
    """Solution of normal equations, whatever the units; None where slopes are sums of others."""
    size = np.sqrt(np.maximum(np.diag(matrix), 0.0))
    if not (size > 0).all():
        return None
    scaled = matrix / size[:, None] / size
    if np.linalg.eigvalsh(scaled)[0] < _RANK:
        return None
    found: np.ndarray = np.linalg.solve(scaled, right / size) / size
    return found

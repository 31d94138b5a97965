"""Rays without light that follow each other through the views: the shadow of something that turns with the object.

The rays beside a sharp rim of metal may be bright, so that one view does not tell metal from pixels that are dead. What
is dead stays in its pixels, and what fails in one view is gone in the next. A shadow goes on, and moves.
"""

from __future__ import annotations

import numpy as np
from scipy import ndimage, sparse

__all__ = ["moving_shadows"]

# A shadow passes over this many times the pixels that it covers in any one view. Pixels that fail now and then
# pass over no more than all of them, of which more than half fail at once where they fail more often than not.
_MOVED = 2
# Views that it must last: of rays that fail at random, one in ten, some 1e-4 make a chain so long.
_LASTS = 5
_AROUND = np.ones((3, 3))


def moving_shadows(values: np.ndarray) -> list[np.ndarray | None]:
    """Which rays without light belong to a shadow that moves; None for views without a shadow.

    A shadow is made of pixels that stay without light for two views or more. Pieces of them in neighbouring views are
    one shadow if they share a pixel.

    Parameters
    ----------
    values : (views, rows, columns) array
        -log(I/I0), infinite where no light was counted.

    Returns
    -------
    list of (rows, columns) bool array or None
    """
    pixels, pieces, numbers, links = [], [], [0], []
    before = np.zeros(values.shape[1:], np.int32)
    for number_of_view in range(len(values)):
        labels, number = _pieces(_staying(values, number_of_view), numbers[-1])
        touching = (labels > 0) & (before > 0)
        links.append(np.unique(np.stack([labels[touching], before[touching]], 1), axis=0))
        place = np.flatnonzero(labels)
        pixels.append(place)
        pieces.append(labels.reshape(-1)[place])
        numbers.append(numbers[-1] + number)
        before = labels
    if not numbers[-1]:
        return [None] * len(values)
    shadows = _shadows(np.concatenate(links) - 1, numbers[-1])
    moves = _moves(pixels, [shadows[one - 1] for one in pieces], values[0].size)
    found: list[np.ndarray | None] = []
    for place, one in zip(pixels, pieces):
        mask = np.zeros(values[0].size, bool)
        mask[place] = moves[shadows[one - 1]]
        found.append(mask.reshape(values.shape[1:]) if len(place) else None)
    return found


def _staying(values: np.ndarray, number: int) -> np.ndarray:
    """Pixels without light in a view and in the one before or after it, (rows, columns) bool: few fail at random so."""
    lightless = np.isposinf(values[number])
    if not lightless.any():
        return lightless
    beside = np.isposinf(values[max(0, number - 1) : number + 2]).sum(axis=0)
    return lightless & (beside > 1)


def _pieces(lightless: np.ndarray, first: int) -> tuple[np.ndarray, int]:
    """Connected pieces without light, numbered from ``first`` + 1 on, 0 elsewhere, and how many there are."""
    if not lightless.any():
        return np.zeros(lightless.shape, np.int32), 0
    labels, number = ndimage.label(lightless, _AROUND)
    return np.where(labels > 0, labels + first, 0), number


def _shadows(links: np.ndarray, number: int) -> np.ndarray:
    """The shadow that each piece belongs to."""
    graph = sparse.coo_matrix((np.ones(len(links), bool), (links[:, 0], links[:, 1])), (number, number))
    return sparse.csgraph.connected_components(graph, directed=False)[1]


def _moves(pixels: list[np.ndarray], shadows: list[np.ndarray], size: int) -> np.ndarray:
    """Whether each shadow lasts, and passes over `_MOVED` times as many pixels as it covers in any one view."""
    number = max(int(one.max()) for one in shadows if len(one)) + 1
    widest, lasts = np.zeros((2, number), np.int64)
    for one in shadows:
        covered = np.bincount(one, minlength=number)
        widest, lasts = np.maximum(widest, covered), lasts + (covered > 0)
    every = np.concatenate(shadows).astype(np.int64) * size + np.concatenate(pixels)
    passed = np.bincount(np.unique(every) // size, minlength=number)
    return (passed >= _MOVED * widest) & (lasts >= _LASTS)

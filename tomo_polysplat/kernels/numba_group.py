"""Numbers of a group of Gaussians side by side, so that the compiler takes several Gaussians in one instruction.

A group is a flat array: number ``i`` of its Gaussian ``k`` is at ``i * GROUP + k``. Being constant, that distance tells
the compiler that what it reads and what it writes do not overlap.
"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.compiled import called, njit
from tomo_polysplat.kernels.gaussian_maths import step, whitening, whitening_adjoint

__all__ = ["GROUP", "SIZE", "add_where", "gaussian_of", "in_threes", "put_group", "take_gradients", "three"]

GROUP = 16
SIZE = 19  # numbers of a Gaussian that `put_group` puts down

# Numba compiles a function of `step` anew for every plain number among its arguments: each takes a Gaussian whole.


@njit(inline="always")
def three(array, at, k):
    """Numbers ``at`` to ``at + 2`` of Gaussian ``k``."""
    return array[at * GROUP + k], array[(at + 1) * GROUP + k], array[(at + 2) * GROUP + k]


@njit(inline="always")
def _rows(array, at, k):
    return three(array, at, k), three(array, at + 3, k), three(array, at + 6, k)


@step
def gaussian_of(group, k):
    """Position, scale and the rows of the whitening matrix of Gaussian ``k``, as tuples."""
    return three(group, 0, k), three(group, 3, k), _rows(group, 10, k)


@step
def _turned_of(group, k):
    """Scale and quaternion."""
    return three(group, 3, k), (*three(group, 6, k), group[9 * GROUP + k])


@step
def add_where(seen, grads, k, point, rows):
    """Add dL/dposition (3) and dL/dW (9) to those of Gaussian ``k``, if ``seen``: else they may be NaN."""
    for i in range(3):
        grads[i * GROUP + k] += point[i] if seen else 0.0
        for j in range(3):
            grads[(3 + 3 * i + j) * GROUP + k] += rows[i][j] if seen else 0.0


@called(error_model="numpy", fastmath={"contract"})
def put_group(first, some, position, scale, rotation, group):
    """Position, scale, rotation and whitening matrix of the Gaussians from ``first`` on, for `gaussian_of`."""
    for k in range(some):
        n = first + k
        for i in range(3):
            group[i * GROUP + k] = position[n, i]
            group[(3 + i) * GROUP + k] = scale[n, i]
        for i in range(4):
            group[(6 + i) * GROUP + k] = rotation[n, i]
    for k in range(GROUP):
        scales, turned = _turned_of(group, k)
        rows = whitening(scales, turned)
        for i in range(3):
            for j in range(3):
                group[(10 + 3 * i + j) * GROUP + k] = rows[i][j]


@called(error_model="numpy", fastmath={"contract"})
def take_gradients(first, some, group, grads, grad_position, grad_scale, grad_rotation):
    """Write the gradients of the Gaussians from ``first`` on, from those by position (3) and W (9) in ``grads``."""
    out = np.empty(7 * GROUP)
    for k in range(GROUP):
        scales, turned = _turned_of(group, k)
        by_scale, by_rotation = whitening_adjoint(scales, turned, _rows(group, 10, k), _rows(grads, 3, k))
        for i in range(3):
            out[i * GROUP + k] = by_scale[i]
        for i in range(4):
            out[(3 + i) * GROUP + k] = by_rotation[i]
    for k in range(some):
        n = first + k
        for i in range(3):
            grad_position[n, i] = grads[i * GROUP + k]
            grad_scale[n, i] = out[i * GROUP + k]
        for i in range(4):
            grad_rotation[n, i] = out[(3 + i) * GROUP + k]


def in_threes(weight):
    """The same, with zeros for channels that are missing to a multiple of three, as the kernels want them."""
    missing = 0 if len(weight) == 1 else -len(weight) % 3
    return np.concatenate([weight, np.zeros((missing, weight.shape[1]), np.float32)]) if missing else weight

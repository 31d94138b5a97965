"""Numbers of a group of Gaussians side by side, so that the compiler takes several Gaussians in one instruction.

A group is a flat array: number ``i`` of its Gaussian ``k`` is at ``i * GROUP + k``. Being constant, that distance tells
the compiler that what it reads and what it writes do not overlap.
"""

from __future__ import annotations

from tomo_polysplat.compiled import called, njit
from tomo_polysplat.kernels.gaussian_maths import whitening

__all__ = ["GROUP", "SIZE", "add_where", "gaussian_of", "moments_of", "put_group"]

GROUP = 16
SIZE = 15  # numbers of a Gaussian that `put_group` puts down

# Inlined by LLVM: where Numba does it, compiling takes a third longer. Numba compiles such a function anew for every
# plain number among its arguments, and so each of them takes a Gaussian whole.
_step = called(error_model="numpy", fastmath={"contract"}, forceinline=True)


@njit(inline="always")
def _three(array, at, k):
    return array[at * GROUP + k], array[(at + 1) * GROUP + k], array[(at + 2) * GROUP + k]


@_step
def gaussian_of(group, k):
    """Position, scale and the rows of the whitening matrix of Gaussian ``k``, as tuples."""
    rows = _three(group, 6, k), _three(group, 9, k), _three(group, 12, k)
    return _three(group, 0, k), _three(group, 3, k), rows


@_step
def moments_of(moments, k):
    """The twelve numbers of Gaussian ``k``, by threes."""
    return _three(moments, 0, k), _three(moments, 3, k), _three(moments, 6, k), _three(moments, 9, k)


@_step
def add_where(seen, grads, k, point, rows):
    """Add dL/dposition (3) and dL/dW (9) to those of Gaussian ``k``, if ``seen``: else they may be NaN."""
    for i in range(3):
        grads[i * GROUP + k] += point[i] if seen else 0.0
        for j in range(3):
            grads[(3 + 3 * i + j) * GROUP + k] += rows[i][j] if seen else 0.0


@called(error_model="numpy")
def put_group(first, some, position, scale, rotation, white, group):
    """Position, scale and whitening matrix of the Gaussians from ``first`` on, for `gaussian_of`."""
    for k in range(some):
        n = first + k
        whitening(scale, rotation, n, white)
        for i in range(3):
            group[i * GROUP + k] = position[n, i]
            group[(3 + i) * GROUP + k] = scale[n, i]
            for j in range(3):
                group[(6 + 3 * i + j) * GROUP + k] = white[i, j]

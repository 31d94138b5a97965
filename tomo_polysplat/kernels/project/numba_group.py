"""Numbers of a group of Gaussians side by side, so that the compiler takes several Gaussians in one instruction.

A group is a flat array: number ``i`` of its Gaussian ``k`` is at ``i * GROUP + k``. Being constant, that distance tells
the compiler that what it reads and what it writes do not overlap.
"""

from __future__ import annotations

from tomo_polysplat.compiled import njit
from tomo_polysplat.kernels.gaussian_maths import whitening

__all__ = ["GROUP", "SIZE", "add_where", "matrix_of", "put", "put_group", "three"]

GROUP = 16
SIZE = 15  # numbers of a Gaussian that `put_group` puts down

# Inlined by LLVM: where Numba does it, compiling takes a third longer.
_step = njit(error_model="numpy", fastmath={"contract"}, forceinline=True)


@_step
def three(array, at, k):
    """Numbers ``at`` to ``at`` + 2 of the Gaussian ``k`` of a group."""
    return array[at * GROUP + k], array[(at + 1) * GROUP + k], array[(at + 2) * GROUP + k]


@_step
def put(array, at, k, values):
    """The contrary of `three`."""
    array[at * GROUP + k], array[(at + 1) * GROUP + k], array[(at + 2) * GROUP + k] = values


@_step
def add_where(seen, array, at, k, values):
    """Add three numbers to those from ``at`` on, if ``seen``: else they may be NaN."""
    array[at * GROUP + k] += values[0] if seen else 0.0
    array[(at + 1) * GROUP + k] += values[1] if seen else 0.0
    array[(at + 2) * GROUP + k] += values[2] if seen else 0.0


@_step
def matrix_of(array, at, k):
    """Nine numbers from ``at`` on, as the rows of a matrix."""
    return three(array, at, k), three(array, at + 3, k), three(array, at + 6, k)


@njit(nogil=True, cache=True, error_model="numpy")
def put_group(first, some, position, scale, rotation, white, group):
    """Position, scale and whitening matrix of the Gaussians from ``first`` on: numbers 0, 3 and 6 on of a group."""
    for k in range(some):
        n = first + k
        whitening(scale, rotation, n, white)
        put(group, 0, k, (position[n, 0], position[n, 1], position[n, 2]))
        put(group, 3, k, (scale[n, 0], scale[n, 1], scale[n, 2]))
        for a in range(3):
            put(group, 6 + 3 * a, k, (white[a, 0], white[a, 1], white[a, 2]))

"""Voxels that a surface crosses, sampled finely."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.compiled import called, njit

__all__ = ["crossed_voxels", "sample_voxels"]

# How far inside its voxel, in edges of it, a point on a face lies: what ends at the face belongs to one side of it.
_INSIDE = 1e-6


def crossed_voxels(labels: np.ndarray, per_voxel: tuple[int, int]) -> np.ndarray:
    """(ny, nx) bool: voxels of a slice whose own sample points, or those next to them, are not all of one part.

    Parameters
    ----------
    labels : (planes, ny b + 2, nx a + 2) int array
        Part at each sample point, with one more on either side of the voxels.
    per_voxel : (a, b)
        Sample points of a voxel along x and y.
    """
    least, most = labels.min(axis=0), labels.max(axis=0)
    for axis, count in ((1, per_voxel[0]), (0, per_voxel[1])):
        around = [np.lib.stride_tricks.sliding_window_view(a, count + 2, axis) for a in (least, most)]
        every = (slice(None), slice(None, None, count)) if axis == 1 else slice(None, None, count)
        least, most = around[0][every].min(axis=-1), around[1][every].max(axis=-1)
    return least != most


# Compiled: it takes arrays and numbers, and no objects that hold them.
@njit(nogil=True, cache=True)
def sample_voxels(corners, size, closed, counts, parts, values, marks, means, mean, marked):
    """Mean value of the sample points of each voxel, and whether any of them is of a marked part.

    Parameters
    ----------
    corners, size : (n, 3) and (3,) arrays
        Lowest corner of each voxel, and the edges of all.
    closed : (3,) bool array
        Along which axes the points reach from face to face; else they are the middles of as many equal cells.
    counts : (3,) int array
        Sample points along x, y and z.
    parts : (round_axes, centre, to_local, half_extent) arrays
        Solids; where several hold a point, the last of them counts.
    values, marks : (parts + 1,) arrays
        By label: 0 is empty space, n part n - 1.
    means : bool
        Whether mean values are asked for; if not, voxels that nothing marked comes near are passed over.
    mean, marked : (n,) arrays
        Written to.
    """
    round_axes, centre, _, half_extent = parts
    near = np.empty(len(round_axes), np.int64)
    labels = np.empty((counts[2], counts[1], counts[0]), np.int64)
    points = np.empty((3, counts.max()))
    turned = np.empty((3, 3, counts.max()))
    for voxel in range(len(corners)):
        count, may_be_marked = 0, marks[0]
        for part in range(len(round_axes) - 1, -1, -1):
            apart = False
            for a in range(3):
                middle = corners[voxel, a] + 0.5 * size[a] - centre[part, a]
                apart = apart or abs(middle) > 0.5 * size[a] + half_extent[part, a]
            if not apart:
                near[count] = part
                count += 1
                may_be_marked = may_be_marked or marks[part + 1]
        marked[voxel] = False
        if not (means or may_be_marked):
            continue
        for a in range(3):
            for i in range(counts[a]):
                points[a, i] = corners[voxel, a] + _place(i, counts[a], closed[a]) * size[a]
        labels[:] = 0
        for n in range(count):
            _label(labels, near[n], points, turned, parts)
        total, found = 0.0, False
        for k in range(counts[2]):
            for j in range(counts[1]):
                for i in range(counts[0]):
                    total += values[labels[k, j, i]]
                    found = found or marks[labels[k, j, i]]
        mean[voxel] = total / (counts[0] * counts[1] * counts[2])
        marked[voxel] = found


@called()
def _place(index, count, closed):
    """Where a sample point lies along an axis of a voxel, 0 to 1."""
    if closed and count > 1:
        return _INSIDE + (1.0 - 2.0 * _INSIDE) * index / (count - 1)
    return (index + 0.5) / count


@called()
def _label(labels, part, points, turned, parts):
    """Label the points (nz, ny, nx) that a part holds and that no other part has; ``turned`` is room to work in."""
    round_axes, centre, to_local, _ = parts
    nz, ny, nx = labels.shape
    for a in range(3):
        for b in range(3):
            for i in range(points.shape[1]):
                turned[a, b, i] = to_local[part, b, a] * (points[a, i] - centre[part, a])
    rounds = round_axes[part]
    for k in range(nz):
        for j in range(ny):
            for i in range(nx):
                reach = 0.0  # more than 1 outside
                for b in range(3):
                    value = turned[0, b, i] + turned[1, b, j] + turned[2, b, k]
                    if b < rounds:
                        reach += value * value
                    elif abs(value) > 1.0:
                        reach += 2.0
                if labels[k, j, i] == 0 and reach <= 1.0:
                    labels[k, j, i] = part + 1

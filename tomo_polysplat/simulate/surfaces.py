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
def sample_voxels(corners, size, closed, counts, parts, values, marks, mean, marked):
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
    mean, marked : (n,) arrays
        Written to.
    """
    round_axes, centre, _, half_extent = parts
    near = np.empty(len(round_axes), np.int64)
    point = np.empty(3)
    for voxel in range(len(corners)):
        count = np.intp(0)  # a plain 0 is a type of its own, for which `_label` would be compiled as well
        for part in range(len(round_axes) - 1, -1, -1):
            apart = False
            for a in range(3):
                middle = corners[voxel, a] + 0.5 * size[a] - centre[part, a]
                apart = apart or abs(middle) > 0.5 * size[a] + half_extent[part, a]
            if not apart:
                near[count] = part
                count += 1
        total, found = 0.0, False
        for k in range(counts[2]):
            point[2] = corners[voxel, 2] + _place(k, counts[2], closed[2]) * size[2]
            for j in range(counts[1]):
                point[1] = corners[voxel, 1] + _place(j, counts[1], closed[1]) * size[1]
                for i in range(counts[0]):
                    point[0] = corners[voxel, 0] + _place(i, counts[0], closed[0]) * size[0]
                    label = _label(point, near, count, parts)
                    total += values[label]
                    found = found or marks[label]
        mean[voxel] = total / (counts[0] * counts[1] * counts[2])
        marked[voxel] = found


@called()
def _place(index, count, closed):
    """Where a sample point lies along an axis of a voxel, 0 to 1."""
    if closed and count > 1:
        return _INSIDE + (1.0 - 2.0 * _INSIDE) * index / (count - 1)
    return (index + 0.5) / count


@called()
def _label(point, near, count, parts):
    """Label of the first of the parts ``near`` that holds a point, or 0."""
    round_axes, centre, to_local, _ = parts
    for n in range(count):
        part = near[n]
        around, inside = 0.0, True
        for a in range(3):
            value = 0.0
            for b in range(3):
                value += to_local[part, a, b] * (point[b] - centre[part, b])
            if a < round_axes[part]:
                around += value * value
            else:
                inside = inside and abs(value) <= 1.0
        if inside and around <= 1.0:
            return part + 1
    return 0

"""Exact path lengths of rays through nested solids, compiled for the CPU.

A ray is ``origin + t direction`` with t between two bounds. Each solid holds it over one interval of t. Where
solids overlap the later one counts: the solids are visited from the last to the first, and each receives the
part of its interval that no later one has taken. The lengths are exact to rounding, whatever the nesting.
"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.compiled import called, njit

__all__ = ["paint_labels", "trace_rays", "trace_view"]

TILE = 16


@called()
def _interval(round_axes, origin, direction):
    """Where a ray in the frame of a unit solid is inside it: (first, last); last <= first means nowhere.

    The circle is solved about the ray's closest point to the axis, which loses no digits far from the solid.
    """
    first, last = -math.inf, math.inf
    if round_axes > 0:
        along = 0.0
        squared = 0.0
        for k in range(round_axes):
            along += origin[k] * direction[k]
            squared += direction[k] * direction[k]
        middle = -along / squared if squared > 0.0 else 0.0
        missed = 0.0
        for k in range(round_axes):
            missed += (origin[k] + middle * direction[k]) ** 2
        if missed >= 1.0:
            return 0.0, 0.0
        if squared > 0.0:
            half = math.sqrt((1.0 - missed) / squared)
            first, last = middle - half, middle + half
    for k in range(round_axes, 3):
        if direction[k] == 0.0:
            if abs(origin[k]) >= 1.0:
                return 0.0, 0.0
        else:
            one = (-1.0 - origin[k]) / direction[k]
            other = (1.0 - origin[k]) / direction[k]
            first = max(first, min(one, other))
            last = min(last, max(one, other))
    return first, last


@called()
def _cover(covered, count, first, last):
    """Add an interval to a sorted list of disjoint ones; returns how much was there, and the new count."""
    before = 0
    while before < count and covered[before, 1] < first:
        before += 1
    hidden = 0.0
    low, high = first, last
    after = before
    while after < count and covered[after, 0] <= last:
        hidden += min(last, covered[after, 1]) - max(first, covered[after, 0])
        low = min(low, covered[after, 0])
        high = max(high, covered[after, 1])
        after += 1
    if after == before:
        for k in range(count, before, -1):
            covered[k, 0], covered[k, 1] = covered[k - 1, 0], covered[k - 1, 1]
    elif after > before + 1:
        for k in range(after, count):
            moved = k - (after - before - 1)
            covered[moved, 0], covered[moved, 1] = covered[k, 0], covered[k, 1]
    covered[before, 0], covered[before, 1] = low, high
    return hidden, count + 1 - (after - before)


# Compiled: it takes arrays and numbers, and no objects that hold them.
@called()
def _trace(origin, direction, bounds, chosen, count, solids, covered, local, out):
    """Add one ray's areal densities to ``out``; ``chosen[:count]`` are the solids it may meet, in order."""
    round_axes, centres, to_local, radii, material, density = solids
    squared = direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2
    length = math.sqrt(squared)
    taken = np.intp(0)  # a plain 0 is a type of its own, for which `_cover` would be compiled as well
    for c in range(count - 1, -1, -1):
        j = chosen[c]
        x = origin[0] - centres[j, 0]
        y = origin[1] - centres[j, 1]
        z = origin[2] - centres[j, 2]
        middle = -(x * direction[0] + y * direction[1] + z * direction[2]) / squared
        missed = (
            (x + middle * direction[0]) ** 2
            + (y + middle * direction[1]) ** 2
            + (z + middle * direction[2]) ** 2
        )
        if missed > radii[j] * radii[j]:
            continue
        for k in range(3):
            row = to_local[j, k]
            local[0, k] = row[0] * x + row[1] * y + row[2] * z
            local[1, k] = row[0] * direction[0] + row[1] * direction[1] + row[2] * direction[2]
        first, last = _interval(round_axes[j], local[0], local[1])
        first = max(first, bounds[0])
        last = min(last, bounds[1])
        if last > first:
            hidden, taken = _cover(covered, taken, first, last)
            out[material[j]] += density[j] * length * max(0.0, last - first - hidden)


@njit(nogil=True, cache=True)
def trace_rays(origins, directions, bounds, solids, out):
    """Areal density (g/cm2) of each material along each ray, added to ``out`` (rays, materials)."""
    total = len(solids[0])
    chosen = np.arange(total)
    covered = np.empty((total + 1, 2))
    local = np.empty((2, 3))
    for i in range(len(origins)):
        _trace(origins[i], directions[i], bounds, chosen, total, solids, covered, local, out[i])


@called()
def _pixel(corner, u, v, row, column, out):
    for k in range(3):
        out[k] = corner[k] + row * v[k] + column * u[k]


@called()
def _plane(start, stop, inner, beam, cone, out):
    """Plane (normal, offset) through two neighbouring corners of a tile and their rays, facing outwards."""
    ray = out[:3]  # the ray, then the normal, in the same place
    for k in range(3):
        ray[k] = start[k] - beam[k] if cone else beam[k]
    a, b, c = stop[0] - start[0], stop[1] - start[1], stop[2] - start[2]
    x, y, z = b * ray[2] - c * ray[1], c * ray[0] - a * ray[2], a * ray[1] - b * ray[0]
    within = (inner[0] - start[0]) * x + (inner[1] - start[1]) * y + (inner[2] - start[2]) * z
    scale = math.copysign(1.0 / math.sqrt(x * x + y * y + z * z), -within)
    out[0], out[1], out[2] = x * scale, y * scale, z * scale
    out[3] = out[0] * start[0] + out[1] * start[1] + out[2] * start[2]


@called()
def _choose(planes, centres, radii, chosen):
    """Solids not wholly outside any of the four planes about a bundle of rays: their indices and number."""
    count = 0
    for j in range(len(radii)):
        outside = False
        for k in range(4):
            height = (
                planes[k, 0] * centres[j, 0] + planes[k, 1] * centres[j, 1] + planes[k, 2] * centres[j, 2]
            )
            outside = outside or height - planes[k, 3] > radii[j]
        if not outside:
            chosen[count] = j
            count += 1
    return count


# Compiled: it takes arrays and numbers, and no objects that hold them.
@njit(nogil=True, cache=True)
def trace_view(cone, beam, corner, u, v, solids, out):
    """Areal densities of one view, added to ``out`` (rows, columns, materials).

    ``beam`` is the source of a cone beam or the direction of a parallel one. Pixels are taken tile by tile,
    so that a ray is tried against the few solids near its tile only.
    """
    rows, columns = out.shape[0], out.shape[1]
    total = len(solids[0])
    chosen = np.empty(total, np.int64)
    covered = np.empty((total + 1, 2))
    local = np.empty((2, 3))
    point = np.empty((5, 3))  # corners of a tile in order round it, then its centre
    planes = np.empty((4, 4))
    pixel, ray = np.empty(3), beam.copy()
    bounds = (0.0, 1.0) if cone else (-math.inf, math.inf)
    for top in range(0, rows, TILE):
        bottom = min(top + TILE, rows)
        for left in range(0, columns, TILE):
            right = min(left + TILE, columns)
            _pixel(corner, u, v, top - 0.5, left - 0.5, point[0])
            _pixel(corner, u, v, top - 0.5, right - 0.5, point[1])
            _pixel(corner, u, v, bottom - 0.5, right - 0.5, point[2])
            _pixel(corner, u, v, bottom - 0.5, left - 0.5, point[3])
            _pixel(corner, u, v, (top + bottom - 1) / 2.0, (left + right - 1) / 2.0, point[4])
            for k in range(4):
                _plane(point[k], point[(k + 1) % 4], point[4], beam, cone, planes[k])
            count = _choose(planes, solids[1], solids[3], chosen)
            for i in range(top, bottom if count else top):
                for j in range(left, right):
                    _pixel(corner, u, v, float(i), float(j), pixel)
                    if cone:
                        for k in range(3):
                            ray[k] = pixel[k] - beam[k]
                    _trace(
                        beam if cone else pixel, ray, bounds, chosen, count, solids, covered, local, out[i, j]
                    )


# Compiled: it takes arrays and numbers, and no objects that hold them.
@njit(nogil=True, cache=True)
def paint_labels(labels, lower, step, first, last, label, round_axes, centre, to_local):
    """Write a label on the points of a grid that lie in a solid, trying ``first <= index < last`` only.

    ``labels`` (z, y, x); point (k, j, i) lies at ``lower + (i, j, k) step``, lower and step being (x, y, z).
    """
    for k in range(first[2], last[2]):
        z = lower[2] + k * step[2] - centre[2]
        for j in range(first[1], last[1]):
            y = lower[1] + j * step[1] - centre[1]
            for i in range(first[0], last[0]):
                x = lower[0] + i * step[0] - centre[0]
                around = 0.0
                inside = True
                for a in range(3):
                    value = to_local[a, 0] * x + to_local[a, 1] * y + to_local[a, 2] * z
                    if a < round_axes:
                        around += value * value
                    else:
                        inside = inside and abs(value) <= 1.0
                if inside and around <= 1.0:
                    labels[k, j, i] = label

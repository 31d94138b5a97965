"""An object that is longer than the volume, seen by a scanner whose rays are known in closed form."""

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.long_object import long_object
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.start.orbit import find_turns

RADIUS = 0.6
GRID = VolumeGrid((8, 11, 11), [-1.0, -1.0, -0.5], [1.0, 1.0, 0.5])


def scanner(beam, height, source=0.0, views=9, rows=41, columns=21, rise=0.0):
    """Sources at a distance of 3, on a helix that rises so far, and see ``height`` above and below themselves."""
    angle = 2 * np.pi * np.arange(views) / views
    across = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    out = np.stack([np.sin(angle), -np.cos(angle), 0 * angle], 1)
    at = np.array([0.0, 0.0, source]) + rise * np.linspace(-0.5, 0.5, views)[:, None] * [0.0, 0.0, 1.0]
    times = 2.0 if beam == "cone" else 1.0
    u, v = 0.12 * times * across, times * 2 * height / (rows - 1) * np.tile([0.0, 0.0, 1.0], (views, 1))
    corner = at - 3.0 * out - 0.5 * (columns - 1) * u - 0.5 * (rows - 1) * v
    return Geometry(beam, at + 3.0 * out if beam == "cone" else -out, corner, u, v, rows, columns)


def points(geometry, count=401):
    """(count, views, rows, columns, 3) along the rays."""
    row, column = np.mgrid[: geometry.rows, : geometry.columns][..., None].astype(np.float32)
    corner, u, v, origin = (
        part[:, None, None].astype(np.float32)
        for part in (geometry.corner, geometry.u, geometry.v, geometry.origin)
    )
    pixel = corner + row * v + column * u
    start = origin if geometry.beam == "cone" else pixel - 6 * origin
    return start + np.linspace(0, 1, count, dtype=np.float32)[:, None, None, None, None] * (pixel - start)


def of_cylinder(where, lower, upper):
    """Which points lie in a cylinder about the axis."""
    z = where[..., 2]
    return (np.hypot(where[..., 0], where[..., 1]) < RADIUS) & (z > lower) & (z < upper)


def found(geometry, lower, upper, grid=GRID):
    where = points(geometry)
    inside = of_cylinder(where, lower, upper)
    values = 0.02 * inside.sum(axis=0).astype(np.float32)
    return long_object(values, geometry, grid, find_turns(geometry)[0]), where, inside


@pytest.mark.parametrize("source", [0.0, 0.2, -0.7])
@pytest.mark.parametrize("height", [0.5, 0.9])
def test_all_that_rays_through_the_volume_meet_of_a_long_rod_is_held(height, source):
    geometry = scanner("cone", height, source)
    long, where, inside = found(geometry, -9.0, 9.0)
    crossed = (inside & (np.abs(where[..., 2]) < 0.5)).any(axis=0)
    assert crossed.any() and not crossed[long.missed].any()
    z = where[..., 2][inside & (crossed & ~long.missed[..., None])[None]]
    assert long.lower <= z.min() + 0.02 and long.upper >= z.max() - 0.02
    # And no more than that by much: the columns tell the radius, and the rows the height, to a pixel or two.
    assert long.lower > min(z.min(), -0.5) - 0.12 and long.upper < max(z.max(), 0.5) + 0.12


def test_rows_that_see_the_rod_beside_the_volume_alone_are_left_out():
    geometry = scanner("cone", 0.9)
    long, where, inside = found(geometry, -9.0, 9.0)
    crossed = (inside & (np.abs(where[..., 2]) < 0.5)).any(axis=(0, 3))
    assert long.missed.any() and long.missed[:, 0].all() and long.missed[:, -1].all()
    assert (~crossed == long.missed).mean() > 0.9 and not (crossed & long.missed).any()


@pytest.mark.parametrize("rise, height", [(1.6, 0.3), (2.4, 0.5), (-1.0, 0.6)])
def test_each_view_of_a_helix_misses_rows_of_its_own(rise, height):
    geometry = scanner("cone", height, views=23, rise=rise)
    long, where, inside = found(geometry, -9.0, 9.0)
    # More than graze it.
    crossed = (inside & (np.abs(where[..., 2]) < 0.5)).sum(axis=0) > 1
    of_row = crossed.any(axis=2)
    assert not (of_row & long.missed).any() and (~of_row == long.missed).mean() > 0.9
    z = where[..., 2][inside & (crossed & ~long.missed[..., None])[None]]
    assert z.min() - 0.15 < long.lower <= z.min() + 0.02 and z.max() - 0.02 <= long.upper < z.max() + 0.15


@pytest.mark.parametrize("lower, upper", [(-0.45, 0.45), (-0.3, 0.58), (-9.0, 0.45)])
def test_ends_that_a_helix_sees_are_found(lower, upper):
    long, _, _ = found(scanner("cone", 0.3, views=41, rise=2.4), lower, upper)
    assert long.upper == pytest.approx(max(upper, 0.5), abs=0.03)
    assert long.lower == (-0.5 if lower > -0.5 else pytest.approx(-0.61, abs=0.02))
    assert long.missed.any() == (lower < -0.5 or upper > 0.5)


def test_an_object_that_ends_within_the_volume_changes_nothing():
    long, _, _ = found(scanner("cone", 0.9), -0.45, 0.45)
    assert (long.lower, long.upper) == (-0.5, 0.5) and not long.missed.any()


def test_an_end_that_is_seen_is_found():
    long, _, _ = found(scanner("cone", 0.9), -0.3, 0.6)
    assert long.lower == -0.5 and long.upper == pytest.approx(0.6, abs=0.05)


def test_parallel_rays_meet_nothing_above_or_below():
    geometry = scanner("parallel", 0.9)
    long, _, _ = found(geometry, -9.0, 9.0)
    assert (long.lower, long.upper) == (-0.5, 0.5)
    z = geometry.corner[0, 2] + np.arange(geometry.rows) * geometry.v[0, 2]
    assert (long.missed == (np.abs(z) > 0.5)).all()


def test_nothing_at_all_is_no_long_object():
    geometry = scanner("cone", 0.9)
    values = np.full((geometry.views, geometry.rows, geometry.columns), np.nan, np.float32)
    long = long_object(values, geometry, GRID, find_turns(geometry)[0])
    assert (long.lower, long.upper) == (-0.5, 0.5) and not long.missed.any()


@pytest.mark.parametrize("narrow", [False, True])
def test_a_long_object_that_is_wider_than_the_volume_is_warned_of(narrow, caplog):
    """What goes on above and below is fitted; what a narrow volume leaves out on its sides is not."""
    geometry = scanner("cone", 0.9)
    values = 0.02 * of_cylinder(points(geometry), -9.0, 9.0).sum(axis=0).astype(np.float32)
    side = 0.4 if narrow else 1.0
    grid = VolumeGrid((8, 11, 11), [-side, -side, -0.5], [side, side, 0.5])
    problem = Problem.of(values, geometry, grid, "cm", None, None, surroundings=0.5)
    closed, words = problem.closed(torch.device("cpu"))
    assert problem.margin[0] and not any(problem.margin[2:])
    assert not closed and "longer than the volume" in words
    assert ("reaches beyond the volume: rays next to it see matter" in caplog.text) == narrow

"""The order of the views is that of the scan, not that of the file."""

import numpy as np
import pytest

from tomo_polysplat.scan.geometry import Geometry
from tomo_polysplat.scan.view_order import sorted_in_place, view_order

COLUMNS = 5


def scan(angles, heights=0.0, rows=3, beam="cone"):
    """Source and detector at ASTRA's ``angles``, at ``heights`` along the axis."""
    heights = np.broadcast_to(heights, np.shape(angles))
    sine, cosine, none = np.sin(angles), np.cos(angles), np.zeros(len(angles))
    towards = np.stack([sine, -cosine, none], 1)
    u, v = np.stack([cosine, sine, none], 1), np.tile([0.0, 0, 1], (len(angles), 1))
    up = heights[:, None] * v
    corner = -towards - 0.5 * (COLUMNS - 1) * u - 0.5 * (rows - 1) * v + up
    return Geometry(beam, towards if beam == "parallel" else 7 * towards + up, corner, u, v, rows, COLUMNS)


def values(geometry, seed=0):
    return np.random.default_rng(seed).normal(size=geometry.shape).astype(np.float32)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_a_turn_from_zero_stays_as_it_is(beam):
    geometry = scan(np.linspace(0, 2 * np.pi, 37, endpoint=False), beam=beam)
    assert np.array_equal(view_order(geometry, values(geometry)), np.arange(37))


@pytest.mark.parametrize("beam", ["cone", "parallel"])
@pytest.mark.parametrize("heights", [0.0, np.arange(41) * 0.3], ids=["circle", "helix"])
def test_sorted_views_are_the_same_in_whatever_order_they_come(beam, heights):
    """Also where two views see the same way, as those of a turn that ends where it began."""
    whole = scan(np.append(np.arange(40) * 2 * np.pi / 20, 0.0), heights, beam=beam)
    data = values(whole)
    data[3, 1], data[40, 0, 2] = np.nan, np.nan
    first = view_order(whole, data)
    mixed = np.random.default_rng(1).permutation(41)
    again = mixed[view_order(whole.select(mixed), data[mixed])]
    for name in ("origin", "corner", "u", "v"):
        assert np.array_equal(getattr(whole, name)[first], getattr(whole, name)[again])
    assert np.array_equal(data[first], data[again], equal_nan=True)


def test_a_helix_is_sorted_along_its_axis():
    """By angle its turns would lie between each other."""
    geometry = scan(np.arange(60) * 2 * np.pi / 20, np.arange(60) * 0.5)
    assert np.array_equal(view_order(geometry, values(geometry)), np.arange(60))


def test_a_wobble_along_the_axis_is_no_helix():
    angles = np.linspace(0, 2 * np.pi, 24, endpoint=False)
    geometry = scan(angles, 0.1 * np.random.default_rng(2).normal(size=24))
    assert np.array_equal(view_order(geometry, values(geometry)), np.arange(24))


@pytest.mark.parametrize("order", [[0, 1, 2, 3, 4], [4, 0, 1, 2, 3], [1, 0, 3, 4, 2], [0, 4, 2, 3, 1]])
def test_views_are_sorted_in_place_as_by_a_copy(order):
    data = np.random.default_rng(2).normal(size=(5, 2, 3))
    expected, place = data[order], data.ctypes.data
    sorted_in_place(data, np.array(order))
    np.testing.assert_array_equal(data, expected)
    assert data.ctypes.data == place

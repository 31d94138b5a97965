"""Rows that end in matter, against the chords of bodies that are known beyond their ends."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from start_phantoms import chords

from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.start.continued import continued, half_width
from tomo_polysplat.start.fdk import fdk
from tomo_polysplat.start.initial import initial_volume

astra = pytest.importorskip("astra")

# A ball that the detector sees a slab of; whole it would take 63 of its columns.
BALL = (((0.0, 0.0, 0.0), 31.0, 0.02),)
FULL = {"cone": 75, "parallel": 75}


def scanner(beam, columns, offset=0.0, arc=2 * np.pi):
    angles = np.linspace(0, arc, 90, endpoint=False)
    if beam == "cone":
        made = astra.create_proj_geom("cone", 1.6, 1.6, 21, columns, angles, 200.0, 120.0)
    else:
        made = astra.create_proj_geom("parallel3d", 1.0, 1.0, 21, columns, angles)
    return from_astra(astra.geom_postalignment(made, (offset, 0.0)), astra.create_vol_geom(64, 64, 9))


def rows(geometry, bodies=BALL):
    return torch.from_numpy(chords(geometry, bodies))


@pytest.mark.parametrize("beam", ["cone", "parallel"])
@pytest.mark.parametrize("share", [0.35, 0.5, 0.7])
def test_a_row_goes_on_as_the_ball_does(beam, share):
    columns = round(share * FULL[beam]) // 2 * 2 + 1
    geometry, grid = scanner(beam, columns)
    wide, wider, words = continued(rows(geometry), geometry, grid)
    more = (wider.columns - columns) // 2
    assert wide.shape == wider.shape and more > 0 and f"{more} columns" in words
    assert torch.equal(wide[:, :, more:-more], rows(geometry))
    # The columns beyond see what a detector that is wide enough sees.
    truth = rows(wider)
    # The last column falls steeply: there half a column is a sixth of the height.
    assert (wide - truth).abs().max() < 0.2 * truth.max()
    assert (wide - truth).abs().mean() < 0.02 * truth.max()
    reach = half_width(rows(geometry), geometry)
    edge = float((truth[:, 10] > 0).sum(dim=1).float().mean()) / 2
    assert reach == pytest.approx(edge, rel=0.1)


def test_filtered_backprojection_is_flat_to_the_rim_of_what_is_seen():
    geometry, grid = scanner("parallel", 37)
    x, y, _ = grid.axes()
    seen = np.hypot(x, y[:, None]) < 18
    plain = fdk(rows(geometry).numpy(), geometry, grid, filter_name="hann")[4] / 0.02
    start, about = initial_volume(rows(geometry).numpy(), geometry, grid)
    assert np.ptp(plain[seen]) > 0.5 and abs(start[4][seen] / 0.02 - 1).max() < 0.1
    assert "continued" in about["reason"]


def test_metal_does_not_make_the_object_smaller():
    geometry, _ = scanner("parallel", 37)
    metal = (*BALL, ((0.0, 0.0, 0.0), 3.0, 1.0))
    assert half_width(rows(geometry, metal), geometry) == pytest.approx(31, rel=0.15)


@pytest.mark.parametrize("columns", [75, 63])
def test_an_object_that_is_seen_whole_is_left_alone(columns):
    geometry, grid = scanner("parallel", columns)
    values = rows(geometry)
    assert half_width(values, geometry) is None
    wide, wider, words = continued(values, geometry, grid)
    assert wide is values and wider is geometry and words == ""


@pytest.mark.parametrize("value", [0.0, np.nan])
def test_nothing_is_seen_whole(value):
    geometry, _ = scanner("parallel", 37)
    assert half_width(torch.full(geometry.shape, value), geometry) is None


def test_a_detector_beside_the_axis_tells_of_one_side_alone():
    geometry, _ = scanner("parallel", 37, offset=9.0)
    assert half_width(rows(geometry), geometry) is None


def test_a_part_of_a_turn_that_is_too_short_for_a_wider_fan_stays():
    geometry, grid = scanner("cone", 51, arc=np.deg2rad(195))
    assert half_width(rows(geometry), geometry) is not None
    assert continued(rows(geometry), geometry, grid)[1] is geometry


def test_no_orbit_tells_of_no_end():
    geometry, _ = scanner("parallel", 37)
    tilted = replace(geometry, origin=geometry.origin + np.linspace(0, 1, 90)[:, None] * [0.0, 0.0, 0.5])
    assert half_width(rows(geometry), tilted) is None


def test_a_row_that_rises_towards_its_ends_goes_on_as_far_as_any():
    geometry, _ = scanner("parallel", 37)
    values = rows(geometry)
    rising = values.max() + 0.1 - values
    assert half_width(rising, geometry) == pytest.approx(18 + 0.75 * 37)

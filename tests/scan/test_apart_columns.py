"""Columns of noise, and of a wrong share of the light, beside what an object makes of a column."""

import logging

import astra
import numpy as np
import pytest

from tomo_polysplat.scan.apart_columns import apart_columns
from tomo_polysplat.scan.usable import usable_rays

ROWS, VIEWS, COLUMNS, AXIS = 12, 60, 41, 20.0
AZIMUTH = np.arange(VIEWS) * 2 * np.pi / VIEWS
PLACE = np.arange(COLUMNS) - AXIS


def chord(radius, centre=0.0):
    """Through a round rod or ball, by column; the centre by view."""
    return 2 * np.sqrt(np.maximum(radius**2 - (PLACE - np.asarray(centre)[..., None]) ** 2, 0)) / 20


def scan(photons=1e4, extra=0.0):
    """-log(I/I0) of a cylinder with a rod that goes round in it, above and below which there is air."""
    rod = 1.5 * chord(4, 9 * np.cos(AZIMUTH))
    values = np.zeros((ROWS, VIEWS, COLUMNS))
    values[2:-2] = chord(16) + rod + extra
    counts = np.random.default_rng(2).poisson(photons * np.exp(-values))
    return -np.log(np.maximum(counts, 1) / photons)


def asked(values, azimuth=AZIMUTH, axis=AXIS):
    bad, doubtful = apart_columns(values, float(np.percentile(values, 99)), axis, azimuth)
    return np.flatnonzero(bad).tolist(), np.flatnonzero(doubtful).tolist()


@pytest.mark.parametrize("photons", [30, 1e3, 1e6])
def test_an_object_makes_no_column_apart(photons):
    assert asked(scan(photons)) == ([], [])
    # Nor do gains of single pixels, as strong as a tenth of the light.
    gains = np.random.default_rng(4).normal(0, 0.1, (ROWS, 1, COLUMNS))
    assert asked(scan(photons) + gains) == ([], [])


@pytest.mark.parametrize("values", [0.1 * scan() - np.log(2), -scan() - 0.1], ids=["dark flats", "sign"])
def test_of_rays_brighter_than_the_open_field_no_column_is_told(values):
    assert np.percentile(values, 99) <= 0
    assert asked(values) == ([], [])


@pytest.mark.parametrize("column", [4, 20, 22, 33])
def test_noise_is_found_wherever_it_lies(column):
    values = scan()
    values[..., column] = np.random.default_rng(3).normal(1.0, 0.5, (ROWS, VIEWS))
    assert asked(values) == ([column], [])


def test_half_of_the_light_is_found_where_no_object_makes_it():
    for column in (8, 30):
        values = scan()
        values[..., column] += np.log(2)
        assert asked(values) == ([column], [])
    # On the axis a rod looks the same, but nothing is brighter than the open beam.
    values = scan()
    values[..., 20] += np.log(2)
    assert asked(values) == ([], [20])
    assert asked(-np.abs(values) * (np.arange(COLUMNS) == 20) + scan() * (np.arange(COLUMNS) != 20)) == (
        [20],
        [],
    )


def test_what_is_round_about_the_axis_is_no_defect():
    thin = np.zeros(COLUMNS)
    thin[20] = 1.0
    assert asked(scan() + thin)[0] == []
    both = np.zeros(COLUMNS)
    both[[8, 32]] = 1.0
    assert asked(scan() + both)[0] == []
    # By the axis that is told, which may be off.
    assert asked(scan() + both, axis=AXIS + 0.7)[0] == []


def test_a_few_degrees_leave_what_is_off_the_axis_in_its_column():
    values = scan()
    values[..., 8] += np.log(2)
    assert asked(values, azimuth=np.linspace(0, 1, VIEWS)) == ([], [8])


def test_too_few_rays_tell_nothing():
    values = scan()
    values[..., 8] += 1.0
    for part in (values[:, :6], values[..., 6:10], values[:1, :50]):
        bad, doubtful = apart_columns(part, 1.0, AXIS, AZIMUTH[: part.shape[1]])
        assert not bad.any() and not doubtful.any()


def test_rays_without_light_are_no_columns_of_noise():
    # Counts of 0 and 1: half of the rays of a column are as their neighbours are, and the others far from them.
    counts = np.random.default_rng(1).poisson(0.15, (ROWS, VIEWS, COLUMNS))
    assert asked(-np.log(np.maximum(counts, 0.5) / 30)) == ([], [])


def test_what_changes_slowly_or_in_all_rows_alike_is_no_noise():
    rng = np.random.default_rng(3)
    slow = np.cumsum(rng.normal(0, 0.3, (ROWS, VIEWS)), axis=1)
    alike = np.broadcast_to(rng.normal(0, 0.5, VIEWS), (ROWS, VIEWS))
    for change in (slow, alike):
        values = scan()
        values[..., 21] += change - change.mean()
        assert asked(values)[0] == []


def test_a_run_leaves_them_out_and_says_so(caplog):
    told = astra.create_proj_geom("parallel3d", 1.0, 1.0, ROWS, COLUMNS, AZIMUTH)
    clean = scan().astype(np.float32)
    values = clean + np.float32(np.log(2)) * (np.arange(COLUMNS) == 8)
    with caplog.at_level(logging.WARNING):
        rays = usable_rays(values, told, None)
    assert "unlike both neighbours in all views, are left out: 8" in caplog.text
    assert rays.counts["rays_of_columns_apart"] == ROWS * VIEWS
    assert np.isnan(rays.values[..., 8]).all()
    rays = usable_rays(clean, told, None)
    assert rays.counts["rays_of_columns_apart"] == 0
    np.testing.assert_array_equal(rays.values, clean.swapaxes(0, 1))

"""The level of air is taken out where rays beside the object tell it, and matter is left where it is."""

from dataclasses import replace

import numpy as np
import pytest

import tomo_polysplat as tps
from tests.small_scans import QUICK, posed
from tomo_polysplat.plan.open_beam import take_out_level
from tomo_polysplat.report.decided import found_about_the_scanner, ray_physics
from tomo_polysplat.report.residuals import residuals_of
from tomo_polysplat.scan.check import check_scan
from tomo_polysplat.scan.geometry import from_astra

ROWS, VIEWS, COLUMNS = 5, 61, 47
PLACES = 2 * (np.arange(COLUMNS) + 0.5) / COLUMNS - 1
ANGLES = np.pi * np.arange(VIEWS)[:, None] / VIEWS
SCANNER = tps.parallel_geometry(pixel=1.0, detector=(ROWS, COLUMNS), degrees=np.degrees(ANGLES[:, 0]))


def chord(radius, x=0.0, y=0.0):
    """(views, columns) of a disc, in half widths of the view."""
    across = PLACES - (x * np.cos(ANGLES) + y * np.sin(ANGLES))
    return 2 * np.sqrt(np.clip(radius**2 - across**2, 0.0, None))


def measured(around=0.0, photons=2e4, depth=1.5, seed=0):
    """(views, rows, columns) -log(I/I0) of a disc, and what else the rays hold."""
    whole = depth * chord(0.5, 0.1, -0.07) + around
    whole = np.broadcast_to(np.asarray(whole), (ROWS, *np.shape(whole)))
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-whole))
    return np.ascontiguousarray((-np.log(np.maximum(counts, 1) / photons)).swapaxes(0, 1), np.float32)


def taken_out(values, given=(), wanted=None, scatter_is_asked=False):
    """What was found, and what rays hold less now."""
    left = values.copy()
    told = take_out_level(
        left, given, *from_astra(*SCANNER), wanted=wanted, scatter_is_asked=scatter_is_asked
    )
    return told, values - left


@pytest.mark.parametrize("level", [0.03, -0.06, 0.262, np.log(2.0)])
def test_an_offset_is_found_within_its_error_and_taken_out_of_all_rays(level):
    told, less = taken_out(measured(level))
    assert np.ptp(less) < 1e-6 and abs(less.mean() - level) < 4 * told.evidence["error"] < 0.15 * abs(level)
    assert told.value == pytest.approx(np.exp(-less.mean()), rel=1e-5)


@pytest.mark.parametrize("photons", [30, 1e3, 2e4, 1e6])
def test_a_clean_scan_is_not_touched(photons):
    for seed in range(8):
        told, less = taken_out(measured(photons=photons, seed=seed))
        assert told.value == 1.0 and not less.any()


@pytest.mark.parametrize(
    "around",
    [
        0.06 * chord(1.1),
        0.02 * chord(2.0),
        0.3 * chord(1.4, 0.2, 0.1),
        0.5 * (chord(1.3) - chord(1.25)),
        0.1 * (chord(0.15, 1.2) + chord(0.15, -0.7, 1.0)),
        0.2 * (PLACES[None] > 0) + 0.0 * ANGLES,
    ],
    ids=["foam", "bath", "off the axis", "tube", "posts", "on one side"],
)
def test_matter_around_is_left_alone(around):
    told, less = taken_out(measured(around, photons=2e5))
    assert told.value == 1.0 and not less.any()


def test_a_falling_source_leaves_its_mean_to_be_taken_out():
    fall = -np.log1p(-0.1 * np.arange(VIEWS) / VIEWS)[:, None] + 0.0 * PLACES
    _, less = taken_out(measured(fall))
    assert less.mean() == pytest.approx(fall.mean(), rel=0.03) and np.ptp(less) < 1e-6


def test_a_brighter_beam_is_left_to_the_question_of_scatter_unless_rays_are_darker_than_that():
    bright = measured(-0.05, photons=2e5)
    told, less = taken_out(bright, scatter_is_asked=True)
    assert "scatter" in told.why and not less.any()
    _, less = taken_out(measured(-0.05, photons=2e5, depth=8.0), scatter_is_asked=True)
    assert less.mean() == pytest.approx(-0.05, rel=0.05)


def test_views_that_were_not_measured_and_given_values_are_no_air():
    values = measured(0.1)
    values[7], values[:, 2, 20], values[30, :, 21:25] = np.nan, np.nan, np.float32(9.5)
    told, less = taken_out(values, given=(float(np.float32(9.5)),))
    assert np.nanmean(less[:, :, :10]) == pytest.approx(0.1, rel=0.02)
    assert not less[30, :, 21:25].any() and abs(np.log(told.value) + 0.1) < 2e-3


def test_left_in_where_asked_and_taken_out_in_doubt_where_asked(caplog):
    told, less = taken_out(measured(0.1), wanted=False)
    assert told.why == "asked for" and not less.any()
    bath = measured(0.05 * chord(1.3), photons=2e5)
    assert taken_out(bath)[0].value == 1.0 and "Matter will seem" in caplog.text
    assert taken_out(bath, wanted=True)[1].mean() > 0.03
    no_noise = np.repeat((1.5 * chord(0.5) + 0.1)[:, None], ROWS, axis=1).astype(np.float32)
    assert not taken_out(no_noise)[1].any()


def test_arrays_and_scans_lose_it_alike_and_check_and_report_tell():
    scan = tps.simulate_scan("pepper", 20, 47, metal=False, photons=2e4)
    dim = replace(scan, projections=scan.projections + np.float32(0.1))
    problem, _ = posed(dim)
    clean, _ = posed(scan)
    assert np.abs(problem.projections - clean.projections).max() < 2e-3
    quick = {"settings": QUICK | {"passes": 0.5}, "calibrate": False, "align": False}
    result = tps.reconstruct(dim, **quick)
    as_arrays = tps.reconstruct(
        dim.projections, dim.proj_geom, dim.vol_geom, spectrum=dim.spectrum, unit=dim.unit, **quick
    )
    assert np.array_equal(result.volume, as_arrays.volume)
    assert ray_physics(result.plan).beam == pytest.approx(np.exp(-0.1), abs=1e-3)
    right = tps.reconstruct(scan, **quick)
    assert residuals_of(result, dim).rms == pytest.approx(residuals_of(right, scan).rms, rel=0.05)
    assert "0.90" in found_about_the_scanner(result.plan)
    finding = next(one for one in check_scan(dim) if one.probe == "open beam")
    assert finding.verdict == "defect" and "as a run does" in finding.remedy

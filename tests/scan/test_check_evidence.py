"""A probe that has no evidence raises nothing and hides nothing."""

import numpy as np
import pytest
from ellipsoids import BODY, chords, cone_scan, noisy, orbit, whole_turn

from tomo_polysplat.scan.assumptions import compare
from tomo_polysplat.scan.axis_offset import AxisOffset
from tomo_polysplat.scan.centre import find_centre
from tomo_polysplat.scan.check import DEFECT, OK, UNKNOWN, check_scan
from tomo_polysplat.scan.probes.opposite import _centre

ROWS, COLUMNS, VIEWS = 25, 47, 60


def verdicts(scan):
    return {finding.probe: finding.verdict for finding in check_scan(scan)}


def test_a_verdict_is_its_text():
    assert [f"{verdict}" for verdict in (OK, DEFECT, UNKNOWN)] == ["ok", "defect", "unknown"] and OK == "ok"


def test_noise_prefers_no_assumption_and_a_difference_is_preferred_by_its_standard_errors():
    rng = np.random.default_rng(0)
    values = rng.normal(size=(16, 40, 9)) ** 2
    found = compare(values.sum(axis=1), np.full((16, 9), 40.0), np.full(9, 640))
    assert found.doubt[found.best] == 0 and found.doubt.max() < 4
    values[..., 3] /= 4
    found = compare(values.sum(axis=1), np.full((16, 9), 40.0), np.full(9, 640))
    assert found.best == 3 and np.delete(found.doubt, 3).min() > 6
    assert compare(np.zeros((3, 2)), np.zeros((3, 2)), np.full(2, 5)) is None


@pytest.mark.parametrize("seed", range(3))
def test_a_plane_of_air_does_not_tell_the_axis(seed):
    """Half a cone: the object lies below the plane of the orbit."""
    vectors = orbit(whole_turn(VIEWS), down=1.5)
    below = [(0.25, (0, 0, -1.5), (1.6, 1.3, 0.9)), (0.5, (0.7, 0.3, -1.5), (0.3, 0.3, 0.5))]
    scan = cone_scan(noisy(chords(vectors, 37, COLUMNS, below), 1e4, seed), vectors, low=-2.4, high=-0.4)
    found = verdicts(scan)
    assert found["centre"] == UNKNOWN and DEFECT not in found.values()


def test_rows_without_a_value_in_the_plane_of_the_orbit_hide_no_other_finding():
    vectors = orbit(whole_turn(VIEWS))
    projections = noisy(chords(vectors, ROWS, COLUMNS))
    projections[10:14] = 0
    found = verdicts(cone_scan(projections, vectors))
    assert found["centre"] == UNKNOWN and found["order of views"] == OK and found["truncation"] == OK


@pytest.mark.parametrize("arc", [60, 180])
def test_a_short_arc_hides_no_other_finding(arc):
    vectors = orbit(np.deg2rad(np.linspace(0, arc, VIEWS)))
    projections = noisy(chords(vectors, ROWS, COLUMNS))
    projections[::6, :, ::7] = 4.0
    found = check_scan(cone_scan(projections, vectors))
    centre = next(finding for finding in found if finding.probe == "centre")
    assert found[0].verdict == DEFECT and centre.verdict == UNKNOWN and "both ends" in centre.remedy


def test_a_pipe_wider_than_the_view_is_truncated_and_no_transmissions():
    vectors = orbit(whole_turn(VIEWS), 20.0, 8.0, 0.09)
    pipe = [
        (0.5, (0, 0, 0), (3.2, 3.2, 50)),
        (-0.5, (0, 0, 0), (2.2, 2.2, 50)),
        (0.2, (0.5, 0.3, 0), (0.3, 0.3, 50)),
    ]
    found = verdicts(cone_scan(noisy(chords(vectors, 9, 64, pipe)), vectors, 3.5))
    assert found["logarithm"] == UNKNOWN and found["truncation"] == DEFECT


@pytest.mark.parametrize("kind", ["helix", "two circles", "flying focal spot"])
def test_neighbours_are_neighbours_by_place(kind):
    tall = [(m, c, (*r[:2], 2 * r[2])) for m, c, r in BODY]
    if kind == "helix":
        vectors = orbit(whole_turn(40, 4), height=np.linspace(-2, 2, 160))
    elif kind == "two circles":
        vectors = np.concatenate([orbit(whole_turn(VIEWS), height=h) for h in (-0.8, 0.8)])
    else:
        vectors = orbit(whole_turn(VIEWS))
        vectors[:, :3] += vectors[:, 6:9] * np.where(np.arange(VIEWS) % 2, 1, -1)[:, None]
    scan = cone_scan(noisy(chords(vectors, 15, COLUMNS, tall)), vectors, low=-3, high=3)
    assert verdicts(scan)["order of views"] == OK
    shuffled = np.random.default_rng(0).permutation(len(vectors))
    scan.projections = np.ascontiguousarray(scan.projections[:, shuffled])
    assert verdicts(scan)["order of views"] == DEFECT


@pytest.mark.parametrize(
    "off, error, verdict", [(0.83, 0.19, UNKNOWN), (0.83, 0.05, DEFECT), (0.3, 0.19, OK)]
)
def test_an_axis_that_may_be_off_is_not_called_right(off, error, verdict):
    found = _centre(AxisOffset(off, error))
    assert found.verdict == verdict and ("short fits" in found.remedy) == (verdict == UNKNOWN)


# Half acquisition


@pytest.mark.parametrize("axis", [120.0, 40.0, 12.25, 229.5])
@pytest.mark.parametrize("photons", [1e3, 3e4])
def test_an_axis_near_the_edge_is_found(axis, photons):
    found = find_centre(_half_acquisition(axis, photons), whole_turn(240))
    assert found.place == pytest.approx(axis, abs=0.1 + 4 * found.uncertainty) and not found.doubt
    assert found.uncertainty < 0.3


def test_an_axis_beyond_what_opposite_views_share_is_called_uncertain():
    assert find_centre(_half_acquisition(5.0, 3e4), whole_turn(240)).doubt


def _half_acquisition(axis, photons, columns=241):
    angles, place = whole_turn(240), (np.arange(columns) + 0.5 - axis) * 3.3 / columns
    lines = 0
    for value, (x, y, _), (a, b, _) in BODY:
        c, s = np.cos(angles)[:, None], np.sin(angles)[:, None]
        wide = (a * c) ** 2 + (b * s) ** 2
        lines = lines + value * 2 * a * b * np.sqrt(np.maximum(wide - (place - x * c - y * s) ** 2, 0)) / wide
    return noisy(lines[None], photons)

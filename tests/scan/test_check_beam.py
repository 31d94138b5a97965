"""The open beam is questioned, and so are voxels that no ray sees."""

import numpy as np
import pytest
from discs import CENTRE, COLUMNS, ROWS, discs
from ellipsoids import chords, cone_scan, noisy, orbit, whole_turn
from one_probe import answer

from tomo_polysplat.scan.check import DEFECT, OK, UNKNOWN, check_scan
from tomo_polysplat.scan.coverage import coverage
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.io import load_scan

VIEWS, LIGHT = 90, 30000


def beam(path):
    return answer(load_scan(path), "open beam")


def written(exchange, light=LIGHT, **changes):
    """A scan of the discs with Poisson counts, as integers."""
    rng = np.random.default_rng(0)
    theta = np.linspace(0, 180, VIEWS, endpoint=False)
    lines = discs(np.deg2rad(theta)).transpose(1, 0, 2)
    counts = rng.poisson(light * np.exp(-lines) + 100)
    flats = rng.poisson(np.full((6, ROWS, COLUMNS), LIGHT + 100.0))
    darks = np.full((5, ROWS, COLUMNS), 100)
    content = {"data": counts, "data_white": flats, "data_dark": darks, "theta": theta}
    return exchange(
        **{name: value(content[name]) for name, value in changes.items()}
        | {name: value for name, value in content.items() if name not in changes}
    )[0]


def test_a_right_open_beam_is_ok(exchange):
    assert beam(written(exchange)).verdict == OK and CENTRE > 0


@pytest.mark.parametrize(
    ("changes", "word"),
    [
        ({"data_white": lambda white: white // 2}, "times the flats"),
        ({"data_white": lambda white: np.concatenate([white[:3], 0 * white[3:] + 100])}, "shutter"),
        ({"data_dark": lambda dark: np.concatenate([dark[:4], dark[4:] + LIGHT])}, "beam was on"),
        ({"data_white": lambda white: np.concatenate([white[:3], 0.85 * white[3:]])}, "falls"),
        (
            {
                "data": lambda data: np.minimum(data, 800).astype(float),
                "data_white": lambda white: np.minimum(white, 800).astype(float),
            },
            "very same value",
        ),
    ],
    ids=["exposure", "shutter", "darks", "tube", "saturated"],
)
def test_a_wrong_open_beam_is_named(exchange, changes, word):
    light = 1000 if word == "very same value" else LIGHT
    found = beam(written(exchange, light, **changes))
    assert found.verdict == DEFECT and word in found.text and found.remedy


def test_voxels_that_no_ray_sees():
    vectors = orbit(whole_turn(40), down=-2.2)
    scan = cone_scan(noisy(chords(vectors, 19, 47)), vectors)
    found = {finding.probe: finding for finding in check_scan(scan)}
    assert found["coverage"].verdict == DEFECT and "first row" in found["coverage"].text
    seen = coverage(*from_astra(scan.proj_geom, scan.vol_geom))
    assert seen.shape == scan.volume_shape and not seen[:4].any() and seen[16, 12, 12] == 1


def test_the_coverage_is_where_the_geometry_projects_voxels():
    scan = cone_scan(np.zeros((9, 12, 21), np.float32), orbit(whole_turn(12), down=0.3))
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    pixels = np.random.default_rng(0).random((9, 21)) < 0.7
    x, y, z = grid.axes()
    for k, j, i in ((3, 5, 7), (12, 12, 12), (20, 2, 19)):
        places = np.round(geometry.project_points(np.array([[x[i], y[j], z[k]]]))[:, 0]).astype(int)
        inside = [0 <= c < 21 and 0 <= r < 9 and pixels[r, c] for c, r in places]
        assert coverage(geometry, grid, pixels)[k, j, i] == pytest.approx(np.mean(inside))


@pytest.mark.parametrize("photons", [30, 1e5])
def test_few_photons_are_no_bad_rays_and_an_object_in_all_columns_leaves_the_beam_unknown(photons):
    vectors = orbit(whole_turn(40), pixel=0.08)
    scan = cone_scan(noisy(chords(vectors, 15, 31), photons), vectors)
    found = {finding.probe: finding.verdict for finding in check_scan(scan)}
    assert found["bad rays"] == OK and found["open beam"] == UNKNOWN


def saturated_to(limit, views, photons):
    """A cone's open beam finding where the camera ends at this share of the open beam, of flats too."""
    vectors = orbit(whole_turn(views))
    lines = chords(vectors, 19, 47)
    lines = lines if photons is None else noisy(lines, photons)
    lines = np.maximum(lines + np.log(limit), 0).astype(np.float32)
    return answer(cone_scan(lines, vectors), "open beam")


@pytest.mark.parametrize("views", [20, 90])
def test_pictures_without_noise_are_not_called_saturated(views):
    """All rays beside the object hold zero: that is no evidence where the object shows no noise either."""
    found = saturated_to(1.0, views, None)
    assert found.verdict == UNKNOWN and found.remedy


@pytest.mark.parametrize("limit", [0.95, 0.7])
@pytest.mark.parametrize("photons", [1e3, 1e5])
def test_a_saturated_open_beam_is_never_ok(limit, photons):
    found = saturated_to(limit, 64, photons)
    assert found.verdict != OK


def test_one_photon_behind_metal_is_a_measurement():
    """Counts of Poisson's law, clipped at one: rays through a rod have one photon or none, and are no bad rays."""
    vectors = orbit(whole_turn(40))
    rod = [(1.0, (0, 0, 0), (1.5, 1.2, 0.9)), (20.0, (0.3, 0.2, 0.0), (0.25, 0.25, 0.9))]
    lines = chords(vectors, 19, 47, rod)
    counts = np.maximum(np.random.default_rng(0).poisson(3000 * np.exp(-lines)), 1)
    scan = cone_scan(-np.log(counts / 3000).astype(np.float32), vectors)
    assert np.mean(counts == 1) > 0.005
    assert answer(scan, "bad rays").verdict == OK


@pytest.mark.parametrize("side", [-1, 1])
def test_a_detector_that_sees_the_other_half_from_the_other_side_is_no_truncation(side):
    """Off by two columns, some 6 %: what one end cuts off, the other one sees half a turn later, up to the air."""
    vectors = orbit(whole_turn(60))
    vectors[:, 3:6] += 2 * side * vectors[:, 6:9]
    columns = next(n for n in range(31, 61) if _ends(vectors, n).count(False) == 1)
    scan = cone_scan(noisy(chords(vectors, 19, columns)), vectors)
    assert answer(scan, "truncation").verdict == OK
    # A short scan does not see it from the other side.
    part = vectors[:32]
    scan = cone_scan(noisy(chords(part, 19, columns)), part)
    assert answer(scan, "truncation").verdict == DEFECT


def _ends(vectors, columns):
    """Whether the first and the last column show air in all views."""
    lines = chords(vectors, 19, columns)
    return [bool((lines[..., end] == 0).all()) for end in (0, -1)]

"""The choice of the start, and what becomes of bad pixels."""

import numpy as np
import pytest
import torch
from start_phantoms import DISCS, SPHERES, chords, distance, relative_error, truth

from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.start import initial
from tomo_polysplat.start.initial import initial_volume, initial_volume_on
from tomo_polysplat.start.whole_rows import fill_rows

astra = pytest.importorskip("astra")


def scan(views, turn=2 * np.pi):
    angles = np.linspace(0, turn, views, endpoint=False)
    proj_geom = astra.create_proj_geom("cone", 2.0, 2.0, 48, 49, angles, 150.0, 80.0)
    return from_astra(proj_geom, astra.create_vol_geom(30, 30, 30, -24, 24, -24, 24, -24, 24))


@pytest.mark.parametrize(
    ("views", "turn", "method", "said"),
    [
        (60, 2 * np.pi, "fdk", "circular orbit, full turn"),
        (20, 2 * np.pi, "sirt", "only 20 views"),
        (60, 0.8 * np.pi, "sirt", "degrees of arc"),
    ],
)
def test_the_method_follows_the_scan(views, turn, method, said):
    geometry, grid = scan(views, turn)
    volume, info = initial_volume(chords(geometry, SPHERES), geometry, grid)
    assert info["method"] == method
    assert said in info["reason"]
    assert info["invalid_pixels"] == 0
    assert volume.shape == grid.shape
    assert volume.dtype == np.float32
    inside = distance(grid, (0, 0, 0)) < 22
    assert relative_error(volume, truth(grid, SPHERES), inside) < (0.15 if turn < 6 else 0.08)


@pytest.mark.parametrize("views", [60, 20])
def test_bad_pixels_are_counted_and_do_little_harm(views):
    geometry, grid = scan(views)
    projections = chords(geometry, SPHERES)
    expected, _ = initial_volume(projections, geometry, grid)
    spoiled = projections.copy()
    spoiled[:, :, 30] = np.nan  # a dead column of the detector
    spoiled[4, 5, 6] = np.inf
    valid = np.ones(geometry.shape, bool)
    valid[7] = False  # a view without light
    given = spoiled.copy()
    volume, info = initial_volume(spoiled, geometry, grid, valid=valid)
    np.testing.assert_array_equal(spoiled, given)
    assert info["invalid_pixels"] == (views - 1) * 48 + 1 + 48 * 49
    assert np.isfinite(volume).all()
    # A dark view is a twentieth of the twenty.
    assert relative_error(volume, expected, slice(None)) < 0.05


def test_a_start_that_is_not_finite_does_not_pass_on(monkeypatch, caplog):
    geometry, grid = scan(60)
    projections = chords(geometry, SPHERES)
    empty = np.full(grid.shape, np.nan, np.float32)
    monkeypatch.setattr(initial, "fdk", lambda *_, **__: empty)
    volume, info = initial_volume(projections, geometry, grid)
    assert info["method"] == "sirt" and "not finite" in info["reason"] and "not finite" in caplog.text
    inside = distance(grid, (0, 0, 0)) < 22
    assert relative_error(volume, truth(grid, SPHERES), inside) < 0.15
    monkeypatch.setattr(initial, "sirt", lambda *_, **__: empty)
    with pytest.raises(ValueError, match="projections: expected .*finite start"):
        initial_volume(projections, geometry, grid)


def test_a_large_start_is_made_coarse_and_keeps_its_place(monkeypatch):
    geometry, grid = scan(20)
    projections = chords(geometry, SPHERES)
    fine, _ = initial_volume(projections, geometry, grid)
    monkeypatch.setattr(initial, "_MOST_STEPS", 1e6)
    volume, _ = initial_volume(projections, geometry, grid)
    assert volume.shape == grid.shape
    expected = truth(grid, SPHERES)
    x, y, z = grid.axes()
    for axes, coordinate in (((0, 1), x), ((0, 2), y), ((1, 2), z)):
        place = [(v.sum(axis=axes) * coordinate).sum() / v.sum() for v in (volume, expected)]
        assert abs(place[0] - place[1]) < 0.25
    assert volume.sum() == pytest.approx(fine.sum(), rel=0.02)
    assert 1e-3 < relative_error(volume, fine, slice(None)) < 0.12


def test_a_planar_start_of_odd_size_is_made_coarse(monkeypatch):
    angles = np.linspace(0, np.pi, 15, endpoint=False)
    geometry, grid = from_astra(
        astra.create_proj_geom("parallel", 1.0, 75, angles), astra.create_vol_geom(51, 47)
    )
    monkeypatch.setattr(initial, "_MOST_STEPS", 1e4)
    projections = chords(geometry, DISCS)
    projections[:, :, 40] = np.nan
    volume, info = initial_volume(projections, geometry, grid)
    assert info["method"] == "sirt"
    assert volume.shape == (1, 51, 47)
    inside = distance(grid, (0, 0, 0)) < 22
    assert relative_error(volume, truth(grid, DISCS), inside) < 0.12


def few_rows(rows, columns, views, cone):
    """A helix, or a stack of slices."""
    angles = np.linspace(0, (4 if cone else 1) * np.pi, views, endpoint=False)
    if not cone:
        return astra.create_proj_geom("parallel3d", 50 / columns, 1.0, rows, columns, angles)
    plain = astra.create_proj_geom("cone", 90 / columns, 4.0, rows, columns, angles, 120.0, 60.0)
    vectors = astra.geom_2vec(plain)["Vectors"]
    vectors[:, [2, 5]] += np.linspace(-4, 4, views)[:, None]
    return astra.create_proj_geom("cone_vec", rows, columns, vectors)


@pytest.mark.parametrize(
    ("rows", "columns", "views", "cone"), [(2, 181, 75, True), (3, 180, 21, False), (7, 90, 21, False)]
)
def test_few_rows_are_made_coarse_along_columns_only(rows, columns, views, cone, monkeypatch):
    proj_geom = few_rows(rows, columns, views, cone)
    slices, end = (10, 10) if cone else (rows, 0.5 * rows)
    geometry, grid = from_astra(proj_geom, astra.create_vol_geom(90, 90, slices, -24, 24, -24, 24, -end, end))
    monkeypatch.setattr(initial, "_MOST_STEPS", 5e3 * views)
    volume, info = initial_volume(chords(geometry, SPHERES[:1]), geometry, grid)
    assert info["method"] == "sirt" and volume.shape == grid.shape
    expected = truth(grid, SPHERES[:1])
    seen = (distance(grid, (0, 0, 0)) < 23) & (np.abs(grid.axes()[2])[:, None, None] < 4)
    assert relative_error(volume, expected, seen) < 0.15
    assert volume[seen].mean() == pytest.approx(expected[seen].mean(), rel=0.03)


def test_filling_is_linear_along_the_row():
    row = np.array([[[np.nan, 1.0, 2.0, np.nan, np.nan, 5.0, np.nan], [np.nan] * 7]], np.float32)
    filled = fill_invalid(row, np.isfinite(row))
    np.testing.assert_allclose(filled[0], [[1, 1, 2, 3, 4, 5, 5], [0] * 7])
    whole = np.ones((2, 3, 4), np.float32)
    assert fill_invalid(whole, np.ones(whole.shape, bool)) is whole


def test_nothing_to_start_from_is_said():
    geometry, grid = scan(20)
    with pytest.raises(ValueError, match="some valid pixels"):
        initial_volume(np.full(geometry.shape, np.nan, np.float32), geometry, grid)
    with pytest.raises(ValueError, match="valid: expected shape"):
        initial_volume(np.ones(geometry.shape, np.float32), geometry, grid, valid=np.ones((2, 2), bool))


def test_rows_are_filled_alike_in_torch():
    """Gaps inside a row, at its ends, of a whole row and of a whole view, against numpy's interpolation."""
    rng = np.random.default_rng(5)
    projections = rng.random((5, 7, 23)).astype(np.float32)
    projections[rng.random(projections.shape) < 0.4] = np.nan
    projections[1, 2], projections[3] = np.nan, np.inf
    projections[0, 0, :4], projections[2, 1, -3:] = np.nan, -np.inf
    projections[4] = 0.5
    before = projections.copy()
    filled = fill_rows(torch.from_numpy(projections)).numpy()
    np.testing.assert_allclose(filled, fill_invalid(projections, np.isfinite(projections)), rtol=1e-6)
    assert np.array_equal(projections, before, equal_nan=True)


@pytest.mark.gpu
def test_a_start_on_the_gpu_is_that_of_the_cpu():
    geometry, grid = scan(90)
    projections = chords(geometry, SPHERES)
    projections[::7, 3, 5:9] = np.nan
    expected, _ = initial_volume(projections, geometry, grid)
    volume, info = initial_volume_on(torch.from_numpy(projections).cuda(), geometry, grid)
    assert volume.is_cuda and info["method"] == "fdk" and info["invalid_pixels"] == 13 * 4
    # Two implementations of filtered backprojection.
    assert float((volume.cpu() - torch.from_numpy(expected)).norm()) < 0.1 * np.linalg.norm(expected)

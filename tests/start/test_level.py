"""Rows made level by moving columns up and down: what the detector sees stays where it is."""

import astra
import numpy as np
import pytest
import torch

from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.moves import Scanner, moved_geometry
from tomo_polysplat.start.level import Level

CPU = torch.device("cpu")
TURN = np.linspace(0, 2 * np.pi, 5, endpoint=False)
GRID = astra.create_vol_geom(8, 8, 8)


def moved(**degrees):
    geometry, _ = from_astra(astra.create_proj_geom("cone", 1.3, 0.9, 30, 41, TURN, 200.0, 120.0), GRID)
    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in degrees.items()}
    return moved_geometry(Scanner(geometry), values)


def pixels(geometry):
    """(views, rows, columns, 3) places."""
    row, column = np.arange(geometry.rows)[:, None, None], np.arange(geometry.columns)[:, None]
    corner, u, v = (part[:, None, None] for part in (geometry.corner, geometry.u, geometry.v))
    return corner + column * u + row * v


@pytest.mark.parametrize("degrees", [{}, {"tilt": 9.0}, {"slant": -7.0}, {"skew": 4.0}, {"roll": 0.05}])
def test_rows_that_are_level_stay(degrees):
    geometry = moved(**degrees)
    level = Level(geometry)
    assert level.geometry is geometry and not level.moved
    values = torch.rand(geometry.shape)
    assert torch.equal(level.values(values, slice(None), (3, 9), CPU), values[:, 3:9])


@pytest.mark.parametrize(
    "degrees", [{"roll": 3.0}, {"roll": -14.0}, {"roll": 6.0, "tilt": 8.0, "slant": 5.0}]
)
def test_a_field_on_the_detector_is_seen_where_it_was(degrees):
    """A quadratic one, which cubic convolution reproduces, as far as the detector reaches."""
    geometry = moved(**degrees)
    level = Level(geometry)
    assert np.abs(level.geometry.u[:, 2]).max() < 1e-12
    turn = np.random.default_rng(1).normal(size=(2, 3))

    def field(places):
        one, two = (places @ vector for vector in turn)
        return 1 + 0.02 * one + 0.001 * one * two

    values = torch.from_numpy(field(pixels(geometry)))
    found = level.values(values, slice(None), (0, level.geometry.rows), CPU)
    places = pixels(level.geometry)
    inverse, source = geometry.projection_matrices()
    local = np.einsum("vkl,vijl->vijk", inverse, places - source[:, None, None])
    row = local[..., 1] / local[..., 2]
    # In the told detector's plane, and in its columns.
    np.testing.assert_allclose(local[..., 2], 1.0, atol=1e-12)
    np.testing.assert_allclose(local[..., 0], np.broadcast_to(np.arange(41), row.shape), atol=1e-9)
    inside = (row >= 1) & (row <= geometry.rows - 2)
    assert inside.mean() > 0.5
    np.testing.assert_allclose(found.numpy()[inside], field(places)[inside], rtol=1e-9)
    # Every pixel is kept, and nothing is made up beyond the ends.
    assert row.min() <= 0 and row.max() >= geometry.rows - 1
    beyond, ends = row <= -2, np.broadcast_to(values[:, :1].numpy(), row.shape)
    np.testing.assert_allclose(found.numpy()[beyond], ends[beyond], rtol=1e-12)


def test_views_may_be_rolled_by_themselves():
    geometries = [moved(roll=degrees) for degrees in (0.0, 2.0, -3.0, 5.0, 1.0)]
    parts = {
        k: np.stack([getattr(g, k)[n] for n, g in enumerate(geometries)])
        for k in ("origin", "corner", "u", "v")
    }
    together = Level(type(geometries[0])("cone", **parts, rows=30, columns=41))
    values = torch.rand((5, 30, 41), dtype=torch.float64)
    more = (together.geometry.rows - 30) // 2
    for n, geometry in enumerate(geometries):
        alone = Level(geometry)
        own = (alone.geometry.rows - 30) // 2
        one = slice(n, n + 1)
        expected = alone.values(values[one], one, (0, alone.geometry.rows), CPU)
        found = together.values(values[one], one, (more - own, more + 30 + own), CPU)
        torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-12)


def test_a_part_of_the_rows_is_part_of_all(monkeypatch):
    from tomo_polysplat.start import level as module

    level = Level(moved(roll=8.0))
    values = torch.rand(level.told.shape)
    whole = level.values(values, slice(None), (0, level.geometry.rows), CPU)
    monkeypatch.setattr(module, "_AT_ONCE", 1)
    for rows in ((0, 2), (5, 17), (level.geometry.rows - 3, level.geometry.rows)):
        assert torch.equal(level.values(values, slice(None), rows, CPU), whole[:, rows[0] : rows[1]])


def test_one_row_stays_a_row():
    geometry, _ = from_astra(astra.create_proj_geom("cone", 1.3, 0.9, 1, 41, TURN, 200.0, 120.0), GRID)
    rolled = moved_geometry(Scanner(geometry), {"roll": torch.tensor(3.0).double()})
    assert Level(rolled).geometry is rolled


@pytest.mark.gpu
def test_a_gpu_sees_the_same_from_the_host_and_from_itself():
    level = Level(moved(roll=8.0))
    values, rows = torch.rand(level.told.shape), (3, level.geometry.rows - 2)
    expected = level.values(values, slice(None), rows, CPU)
    for source in (values, values.cuda()):
        found = level.values(source, slice(None), rows, torch.device("cuda"))
        assert found.is_cuda
        torch.testing.assert_close(found.cpu(), expected, rtol=1e-5, atol=1e-6)

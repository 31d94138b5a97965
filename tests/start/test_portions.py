"""A scan that is filtered and backprojected by portions of its views. The CPU plays ASTRA."""

import json
import math

import astra
import astra.experimental
import numpy as np
import pytest
import torch
from astra.log import AstraError
from start_phantoms import SPHERES, chords
from torch.profiler import ProfilerActivity, profile

from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.moves import Scanner, moved_geometry
from tomo_polysplat.start import astra_fdk, astra_pair, slabs, whole_rows
from tomo_polysplat.start.backproject import accumulate, voxel_maps
from tomo_polysplat.start.continued import continuation, continued
from tomo_polysplat.start.fdk import fdk
from tomo_polysplat.start.level import Level, LevelRows
from tomo_polysplat.start.orbit import find_orbit
from tomo_polysplat.start.whole_rows import WholeRows, fill_rows

CPU, VIEWS = torch.device("cpu"), 100
TURN = np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)
VOLUME = astra.create_vol_geom(33, 29, 21, -29, 29, -33, 33, -20, 20)


def scanned(columns=60, roll=0.0):
    made = astra.create_proj_geom("cone", 2.2, 1.7, 31, columns, TURN, 200.0, 120.0)
    geometry, grid = from_astra(made, VOLUME)
    geometry = moved_geometry(Scanner(geometry), {"roll": torch.tensor(roll, dtype=torch.float64)})
    return torch.from_numpy(chords(geometry, SPHERES).astype(np.float32)), geometry, grid


def spoiled(values):
    """A ray in a thousand is bad, and so is a whole row."""
    bad = torch.from_numpy(np.random.default_rng(0).random(values.shape) < 1e-3)
    values = values.masked_fill(bad, math.nan)
    values[3, 5] = math.nan
    return values


class Played:
    """ASTRA's backprojection by our own, which has no weight for the area of a pixel nor the volume of a voxel."""

    def __init__(self, geometry, grid, device):
        self.maps, self.shape, self.calls = voxel_maps(geometry, grid), grid.shape, []
        area = np.linalg.norm(np.cross(geometry.u, geometry.v), axis=1) / np.prod(grid.voxel_size)
        self.area = torch.from_numpy(area.astype(np.float32))[:, None, None]

    def __enter__(self):
        return self

    def __exit__(self, *error):
        assert all(len(views) == 32 for views in self.calls[:-1]) and len(self.calls) > 1

    def adjoint(self, projections, views):
        assert not self.calls, "only the first portion makes a volume"
        volume = torch.zeros(self.shape)
        self.add_adjoint(volume, projections, views)
        return volume

    def add_adjoint(self, volume, projections, views):
        self.calls.append(views)
        rows = projections / self.area[views]
        accumulate(volume.numpy(), np.ascontiguousarray(rows.numpy()), self.maps[views])


@pytest.fixture
def played(monkeypatch):
    """Portions of 32 views, as ASTRA adds them up."""
    monkeypatch.setattr(astra_pair, "AstraPair", Played)
    monkeypatch.setattr(astra_fdk, "_AT_ONCE", 1)
    monkeypatch.setattr(slabs, "free_bytes", lambda device: 1e10)


@pytest.mark.parametrize("roll", [0.0, 5.0])
def test_portions_add_up_to_the_volume_of_all_views(played, roll):
    values, geometry, grid = scanned(roll=roll)
    whole = fdk(values.numpy(), geometry, grid, filter_name="hann")
    found = slabs.fdk_on_device(values, geometry, grid, find_orbit(geometry)[0], "hann", CPU).numpy()
    x, y, _ = grid.axes()
    # Beyond it a GPU filters fewer columns.
    ellipse = (x / 29) ** 2 + (y[:, None] / 33) ** 2 < 1
    np.testing.assert_allclose(found[:, ellipse], whole[:, ellipse], rtol=0, atol=1e-5 * whole.max())
    assert whole.max() > 0


@pytest.mark.parametrize("roll", [0.0, 5.0])
@pytest.mark.parametrize("columns", [60, 24])
def test_what_is_made_of_some_views_is_that_of_all(columns, roll):
    """To the bit: bad rays filled, rows that end in matter continued, and those of a rolled detector made level."""
    values, geometry, grid = scanned(columns, roll)
    values = spoiled(values)
    wide, wider, words = continued(fill_rows(values), geometry, grid)
    assert bool(words) == (columns == 24), "the small detector is too small"
    found = continuation(fill_rows(values), geometry, grid)
    level = Level(wider)
    rows = (4, level.geometry.rows - 3)
    made = LevelRows(level, WholeRows(values, found), rows, CPU)
    whole = level.values(wide, slice(None), rows, CPU)
    assert made.shape == whole.shape and bool(torch.isfinite(whole).all())
    for some in (slice(0, 32), slice(96, 100), slice(None)):
        assert torch.equal(made[some], whole[some])
    # Every other view, as of half a scan.
    index = torch.arange(1, VIEWS, 2)
    half = WholeRows(values, found, index)
    assert half.shape == wide[index].shape and len(half[2:4]) == 2
    assert torch.equal(half[2:4, 1:9].to(CPU), wide[index][2:4, 1:9])


def test_no_copy_of_the_scan_is_made(played, tmp_path):
    """Besides the volume a portion as it is, filled and filtered is there at most, and what a view takes."""
    values, geometry, grid = scanned()
    values, orbit = spoiled(values), find_orbit(geometry)[0]
    rows = WholeRows(values, continuation(fill_rows(values), geometry, grid))
    with (
        pytest.MonkeyPatch.context() as patch,
        profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiled,
    ):
        patch.setattr(astra_fdk, "_FILTERED_AT_ONCE", 1)
        patch.setitem(whole_rows._AT_ONCE, "cpu", 1)
        slabs.fdk_on_device(rows, geometry, grid, orbit, "hann", CPU)
    profiled.export_chrome_trace(str(tmp_path / "trace.json"))
    events = json.loads((tmp_path / "trace.json").read_text())["traceEvents"]
    events = sorted((e for e in events if e.get("name") == "[memory]"), key=lambda event: event["ts"])
    most = max(np.cumsum([e["args"]["Bytes"] for e in events]))
    assert 4 * math.prod(grid.shape) < most < 4 * math.prod(grid.shape) + values.nbytes


@pytest.mark.parametrize("fails", [False, True])
def test_astra_adds_to_a_volume_of_torch(monkeypatch, fails):
    """It is linked and not copied, what is linked is let go of, and a failure is an error of its own kind."""
    values, geometry, grid = scanned()
    linked, let_go = [], []

    def add(projector, volume, sinogram):
        if fails:
            raise AstraError("no room")
        linked[volume] += linked[sinogram].sum()

    monkeypatch.setattr(astra_pair, "gpu_index", lambda _: 0)
    monkeypatch.setattr(astra_pair, "make_room", lambda *_: None)
    monkeypatch.setattr(astra_pair, "free_bytes", lambda _: 16)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda *_: torch.cuda.Stream)
    monkeypatch.setattr(torch.cuda, "Stream", type("Stream", (), {"synchronize": staticmethod(lambda: None)}))
    monkeypatch.setattr(astra_pair.AstraPair, "_projector", lambda *_: 1)
    monkeypatch.setattr(
        astra.data3d, "link", lambda kind, about, data: linked.append(data) or len(linked) - 1
    )
    monkeypatch.setattr(astra.data3d, "delete", let_go.extend)
    monkeypatch.setattr(astra.experimental, "accumulate_BP", add, raising=False)
    volume, some = torch.ones(grid.shape), values[32:40]
    pair = astra_pair.AstraPair(geometry, grid, CPU)
    if fails:
        with pytest.raises(RuntimeError, match="no room"):
            pair.add_adjoint(volume, some, np.arange(32, 40))
    else:
        pair.add_adjoint(volume, some, np.arange(32, 40))
        assert torch.equal(volume, torch.ones(grid.shape) + some.transpose(0, 1).contiguous().sum())
    assert let_go == [0, 1] and linked[1].shape == (31, 8, 60)


@pytest.mark.gpu
@pytest.mark.parametrize("views", [64, 100])
def test_astra_by_portions_is_astra_at_once(monkeypatch, views):
    """To the bit, as it adds up 32 views at a time anyway; each view is filtered by itself."""
    monkeypatch.setattr(astra_fdk, "_FILTERED_AT_ONCE", 1)
    values, geometry, grid = scanned()
    values, geometry = values[:views].cuda(), geometry.select(np.arange(views))
    orbit = find_orbit(geometry)[0]
    whole = astra_fdk.fdk_cuda_tensor(values, geometry, grid, orbit, "hann")
    monkeypatch.setattr(astra_fdk, "_AT_ONCE", 1)
    assert torch.equal(astra_fdk.fdk_cuda_tensor(values, geometry, grid, orbit, "hann"), whole)
    assert float(whole.max()) > 0

"""Filtered backprojection by slabs is that in one piece, from the rows alone that a slab needs."""

import astra
import numpy as np
import pytest
import torch
from start_phantoms import SPHERES, chords

from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.start import slabs
from tomo_polysplat.start.fdk import fdk
from tomo_polysplat.start.orbit import find_orbit
from tomo_polysplat.start.slabs import fdk_of_slabs, rows_of, slab_of

TURN = np.linspace(0, 2 * np.pi, 50, endpoint=False)
VOLUME = astra.create_vol_geom(33, 29, 41, -29, 29, -33, 33, -30, 40)


def scanned(kind):
    if kind == "parallel":
        made = astra.create_proj_geom("parallel3d", 1.5, 1.1, 61, 70, TURN / 2)
    else:
        made = astra.create_proj_geom("cone", 2.2, 1.7, 53, 60, TURN, 200.0, 120.0)
        # Higher than the volume's middle, beside the axis: part of the volume is beyond the detector.
        made = astra.geom_postalignment(made, (1.3, 6.0))
    geometry, grid = from_astra(made, VOLUME)
    return chords(geometry, SPHERES).astype(np.float32), geometry, grid


@pytest.mark.parametrize("kind", ["cone", "parallel"])
@pytest.mark.parametrize("depth", [1, 7, 40])
def test_slabs_make_the_same_volume(kind, depth):
    projections, geometry, grid = scanned(kind)
    whole, seen = fdk(projections, geometry, grid), []

    def make(rows, cropped, slab):
        seen.append(rows[1] - rows[0])
        return torch.from_numpy(fdk(projections[:, rows[0] : rows[1]], cropped, slab))

    found = torch.full(grid.shape, torch.nan)
    fdk_of_slabs(make, geometry, grid, depth, found)
    np.testing.assert_allclose(found.numpy(), whole, rtol=0, atol=1e-5 * np.abs(whole).max())
    assert len(seen) == -(-41 // depth)
    assert depth == 40 or max(seen) < 0.6 * geometry.rows, "a slab takes a part of the rows"


def test_a_slab_beyond_the_detector_takes_its_nearest_rows():
    _, geometry, grid = scanned("cone")
    far = grid.shifted(np.array([0, 0, 500.0]))
    assert rows_of(geometry, far) == (geometry.rows - 2, geometry.rows)
    assert rows_of(geometry, grid.shifted(np.array([0, 0, -500.0]))) == (0, 2)
    assert slab_of(grid, 3, 5).axes()[2] == pytest.approx(grid.axes()[2][3:5])


def test_a_gpu_that_has_no_room_gets_smaller_slabs(monkeypatch):
    """The CPU plays ASTRA: what is left of a GPU decides how deep slabs are, and less is tried once more."""
    from tomo_polysplat.start import astra_fdk

    projections, geometry, grid = scanned("cone")
    made, room = [], [3e8]

    def play(piece, cropped, slab, orbit, filter_name):
        made.append(slab.shape[0])
        if slab.shape[0] > 12:
            raise RuntimeError("no room.")
        return torch.from_numpy(fdk(piece[:].numpy(), cropped, slab, filter_name=filter_name))

    monkeypatch.setattr(slabs, "_FILTER", 0)
    monkeypatch.setattr(slabs, "free_bytes", lambda device: room[0])
    monkeypatch.setattr(astra_fdk, "fdk_cuda_tensor", play)
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: None)
    orbit, cpu = find_orbit(geometry)[0], torch.device("cpu")
    values, whole = torch.from_numpy(projections), fdk(projections, geometry, grid, filter_name="hann")
    with pytest.raises(RuntimeError, match="no room"):
        slabs.fdk_on_device(values, geometry, grid, orbit, "hann", cpu)
    assert made == [41, 41, 41]
    made.clear()
    enough = (size for size in np.geomspace(1e5, 1e8, 300) if slabs._depth(geometry, grid, 0.8 * size) == 21)
    room[0] = next(enough)
    found = slabs.fdk_on_device(values, geometry, grid, orbit, "hann", cpu)
    np.testing.assert_allclose(found.numpy(), whole, rtol=0, atol=1e-5 * np.abs(whole).max())
    assert made[0] == 21 and max(made[1:]) <= 11, "less was tried"


@pytest.mark.parametrize("room", [1e9, 1e6])
def test_a_rolled_detector_by_slabs_or_in_one_piece(monkeypatch, room):
    """The CPU plays ASTRA, which gets level rows, those alone that a slab needs."""
    from tomo_polysplat.scan.moves import Scanner, moved_geometry
    from tomo_polysplat.start import astra_fdk

    _, geometry, grid = scanned("cone")
    geometry = moved_geometry(Scanner(geometry), {"roll": torch.tensor(6.0).double()})
    projections, made = chords(geometry, SPHERES), []

    def play(piece, cropped, slab, orbit, filter_name):
        made.append(slab.shape[0])
        return torch.from_numpy(fdk(piece[:].numpy(), cropped, slab, filter_name=filter_name))

    monkeypatch.setattr(slabs, "_FILTER", 0)
    monkeypatch.setattr(slabs, "free_bytes", lambda device: room)
    monkeypatch.setattr(astra_fdk, "fdk_cuda_tensor", play)
    whole, orbit = fdk(projections, geometry, grid, filter_name="hann"), find_orbit(geometry)[0]
    found = slabs.fdk_on_device(
        torch.from_numpy(projections), geometry, grid, orbit, "hann", torch.device("cpu")
    )
    assert (len(made) == 1) == (room > 1e8)
    np.testing.assert_allclose(found.numpy(), whole, rtol=0, atol=1e-5 * np.abs(whole).max())
    assert (whole == 0).all(axis=(1, 2)).any() and (whole != 0).any(), "slices beyond the detector are empty"


# Textures interpolate by weights of 8 bits, which the other coordinates of a slab round another way: 5e-5 on an H200.
_TEXTURE = 2e-4


@pytest.mark.gpu
def test_astra_by_slabs_is_astra_in_one_piece():
    made = astra.create_proj_geom("cone", 2.2, 1.7, 53, 60, TURN, 200.0, 120.0)
    geometry, grid = from_astra(
        made, astra.create_vol_geom(41, 29, 33, -14.5, 14.5, -20.5, 20.5, -16.5, 16.5)
    )
    values = torch.from_numpy(chords(geometry, SPHERES).astype(np.float32)).cuda()
    from tomo_polysplat.start.astra_fdk import fdk_cuda_tensor

    orbit = find_orbit(geometry)[0]
    whole = fdk_cuda_tensor(values, geometry, grid, orbit, "hann").cpu()
    for host in (False, True):
        found, source = torch.full(grid.shape, torch.nan), values.cpu() if host else values

        def make(rows, cropped, slab, source=source):
            return fdk_cuda_tensor(source[:, rows[0] : rows[1]].cuda(), cropped, slab, orbit, "hann")

        fdk_of_slabs(make, geometry, grid, 7, found)
        assert float((found - whole).abs().max()) < _TEXTURE * float(whole.abs().max())


@pytest.mark.gpu
def test_a_gpu_with_little_room_makes_slabs(monkeypatch):
    made = astra.create_proj_geom("cone", 2.2, 1.7, 53, 60, TURN, 200.0, 120.0)
    geometry, grid = from_astra(
        made, astra.create_vol_geom(41, 29, 33, -14.5, 14.5, -20.5, 20.5, -16.5, 16.5)
    )
    values, cuda = torch.from_numpy(chords(geometry, SPHERES).astype(np.float32)), torch.device("cuda")
    orbit = find_orbit(geometry)[0]
    whole = slabs.fdk_on_device(values, geometry, grid, orbit, "hann", cuda)
    assert whole.is_cuda
    monkeypatch.setattr(slabs, "_FILTER", 0)
    for room in (1e6, 3e6):
        monkeypatch.setattr(slabs, "free_bytes", lambda device, room=room: room)
        found = slabs.fdk_on_device(values, geometry, grid, orbit, "hann", cuda)
        assert float((found.cpu() - whole.cpu()).abs().max()) < _TEXTURE * float(whole.abs().max())

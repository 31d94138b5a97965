"""Regions of interest: matter around the volume, which the detector does not see either."""

import astra
import numpy as np
import pytest
import torch
from small_scans import disc

import tomo_polysplat as tps
from tomo_polysplat.fit.surroundings import NO_MARGIN, cut_out, go_on, surroundings_of
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.simulate.phantom import Part, Phantom
from tomo_polysplat.simulate.scanner import Scanner
from tomo_polysplat.simulate.scenes import scan_phantom
from tomo_polysplat.simulate.shapes import cylinder, ellipsoid

# What the scanner did to the light is asked in other files.
QUICK = {"passes": 6.0, "views_per_step": 8, "gains": False, "drift": False}
HOST = torch.device("cpu")

SPECTRUM = tps.Spectrum.from_tube(90, filters={"Al": 0.1})
WATER = 0.9 * 0.25  # radius of the disc in cm


@pytest.fixture(scope="module")
def region():
    """The middle 29 of 61 columns of a disc of water with PMMA in it, and a volume as wide as they see."""
    values, proj_geom, _ = disc("pmma", SPECTRUM)
    width = proj_geom["DetectorWidth"]
    proj_geom = astra.create_proj_geom("parallel", width, 29, proj_geom["ProjectionAngles"])
    half = 14.5 * width
    return values[:, 16:45], proj_geom, astra.create_vol_geom(27, 27, -half, half, -half, half)


def fitted(region, **settings):
    return tps.reconstruct(
        *region, spectrum=SPECTRUM, unit="cm", device="cpu", align=False, settings=QUICK | settings
    )


def test_what_lies_around_is_fitted_and_cut_off(region):
    alone, both = fitted(region, surroundings=0.0), fitted(region)
    assert both.volume.shape == alone.volume.shape == (27, 27)
    assert "voxels more on every side" in both.plan["window"].why
    assert "voxels more" not in alone.plan["window"].why
    place = (np.arange(27) - 13) / 13.5
    ring = np.hypot(place, place[:, None])
    ring = (ring > 0.75) & (ring < 0.95)
    water = mass_attenuation("water", [SPECTRUM.effective_energy])[0]
    off = [abs(result.volume[ring].mean() / water - 1) for result in (alone, both)]
    assert off[1] < 0.04 and off[1] < 0.3 * off[0]
    # Other energies and maps have the shape that was asked for, too; the Gaussians tell of what lies around.
    assert both.attenuation(60.0).shape == both.material.shape == both.density.shape == (27, 27)
    assert np.abs(both.gaussians["position"][:, :2]).max() > region[2]["option"]["WindowMaxX"]


def test_a_larger_volume_that_memory_does_not_hold_is_refused_with_what_to_do(region, monkeypatch):
    def no_room(rays, voxels, *_):
        if voxels > 27 * 27:
            raise MemoryError("too many voxels")

    monkeypatch.setattr("tomo_polysplat.reconstruction.require_machine", no_room)
    with pytest.raises(MemoryError, match="too many voxels.*more on every side.*'surroundings': 0"):
        fitted(region)


def test_callbacks_see_what_was_asked_for(region):
    shapes = []
    tps.reconstruct(
        *region, spectrum=SPECTRUM, unit="cm", device="cpu", settings=QUICK | {"passes": 1.0},
        callbacks=[lambda state: shapes.append(state.volume().shape)],
    )  # fmt: skip
    assert shapes and set(shapes) == {(27, 27)}


def test_the_volume_is_widened_to_where_a_round_object_ends(region):
    values, proj_geom, vol_geom = region
    geometry, grid = from_astra(proj_geom, vol_geom)
    rays = projections_from_astra(values, proj_geom)
    around = surroundings_of(rays, geometry, grid, 0.5, HOST)
    wider, margin, why = around.grid, around.margin, around.why
    assert wider.upper[0] == pytest.approx(WATER, rel=0.1) and wider.lower[1] == -wider.upper[1]
    assert np.allclose(wider.voxel_size, grid.voxel_size) and wider.shape[0] == 1
    assert "0.2" in why and margin[2] == margin[3] == (wider.shape[1] - 27) // 2 and not any(margin[:2])
    assert surroundings_of(rays, geometry, grid, 0.1, HOST).margin == (0, 0, 3, 3)
    assert surroundings_of(rays, geometry, grid, 0.0, HOST).grid is grid


def test_a_volume_that_holds_all_is_not_widened(region):
    values, proj_geom, _ = region
    large = astra.create_vol_geom(45, 45, -0.25, 0.25, -0.25, 0.25)
    geometry, grid = from_astra(proj_geom, large)
    assert surroundings_of(projections_from_astra(values, proj_geom), geometry, grid, 0.5, HOST).grid is grid
    whole = disc("pmma", SPECTRUM)
    small = from_astra(whole[1], region[2])
    assert surroundings_of(projections_from_astra(*whole[:2]), *small, 0.5, HOST).margin == NO_MARGIN


def test_cut_out_is_what_was_asked_for():
    volume = np.arange(2 * 7 * 9.0).reshape(2, 7, 9)
    assert np.array_equal(cut_out(volume, (0, 0, 2, 3)), volume[:, 2:5, 3:6])
    assert np.array_equal(cut_out(volume[None], (1, 0, 0, 1)), volume[None, 1:, :, 1:8])
    assert np.array_equal(cut_out(volume[0], (0, 0, 2, 3)), volume[0, 2:5, 3:6])
    assert cut_out(volume, NO_MARGIN) is volume


def test_empty_slices_of_the_margin_go_on_as_the_next_ones():
    volume = torch.zeros(7, 1, 1)
    volume[[1, 2, 4, 5], 0, 0] = torch.tensor([1.0, 2.0, 4.0, 5.0])
    go_on(volume, (2, 1, 0, 0))
    assert volume[:, 0, 0].tolist() == [1, 1, 2, 0, 4, 5, 5], "of what was asked for nothing is filled"


@pytest.fixture(scope="module")
def rod():
    """A rod that is twice as long as the volume and the detector are high, with a cavity at one end of the volume."""
    parts = [
        Part(cylinder((0, 0, 0), 3.5, 10.0), "pmma", 1.19),
        Part(ellipsoid((1.0, 0.5, 3.4), 1.0), "water", 0.5),
    ]
    angles = 2 * np.pi * np.arange(30) / 30
    proj_geom = astra.create_proj_geom("cone", 0.75, 0.75, 20, 24, angles, 12.0, 6.0)
    vol_geom = astra.create_vol_geom(20, 20, 20, -5, 5, -5, 5, -5, 5)
    return scan_phantom(Phantom(parts), proj_geom, vol_geom, SPECTRUM, Scanner(1e5))


def test_a_rod_that_goes_on_is_right_up_to_the_ends_of_the_volume(rod):
    ends, off, whys = np.r_[0:2, 18:20], [], []
    for share in (0.0, 0.5):
        settings = QUICK | {"views_per_step": 2, "surroundings": share}
        result = tps.reconstruct(rod, device="cpu", align=False, settings=settings)
        assert result.volume.shape == (20, 20, 20)
        within = rod.truth > 0.9 * np.median(rod.truth[10][rod.truth[10] > 0])
        errors = [(result.volume - rod.truth)[z][within[z]].mean() for z in ends]
        off.append(np.abs(errors).max() / rod.truth.max())
        whys.append(result.plan["window"].why)
    assert "slices more" in whys[1] and "slices more" not in whys[0]
    assert off[1] < 0.08 and off[1] < 0.3 * off[0]

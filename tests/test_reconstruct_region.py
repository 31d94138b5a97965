"""Regions of interest: matter around the volume, which the detector does not see either."""

import astra
import numpy as np
import pytest
import torch
from small_scans import disc

import tomo_polysplat as tps
from tomo_polysplat.fit.surroundings import cut_out, widened_grid
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra

QUICK = {"passes": 6.0, "views_per_step": 8}
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
    return tps.reconstruct(*region, spectrum=SPECTRUM, unit="cm", device="cpu", settings=QUICK | settings)


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
    wider, margin, why = widened_grid(rays, geometry, grid, 0.5, HOST)
    assert wider.upper[0] == pytest.approx(WATER, rel=0.1) and wider.lower[1] == -wider.upper[1]
    assert np.allclose(wider.voxel_size, grid.voxel_size) and wider.shape[0] == 1
    assert "0.2" in why and margin[0] == margin[1] == (wider.shape[1] - 27) // 2
    assert widened_grid(rays, geometry, grid, 0.1, HOST)[1] == (3, 3)
    assert widened_grid(rays, geometry, grid, 0.0, HOST)[0] is grid


def test_a_volume_that_holds_all_is_not_widened(region):
    values, proj_geom, _ = region
    large = astra.create_vol_geom(45, 45, -0.25, 0.25, -0.25, 0.25)
    geometry, grid = from_astra(proj_geom, large)
    assert widened_grid(projections_from_astra(values, proj_geom), geometry, grid, 0.5, HOST)[0] is grid
    whole = disc("pmma", SPECTRUM)
    small = from_astra(whole[1], region[2])
    assert widened_grid(projections_from_astra(*whole[:2]), *small, 0.5, HOST)[1] == (0, 0)


def test_cut_out_is_the_middle():
    volume = np.arange(2 * 7 * 9.0).reshape(2, 7, 9)
    assert np.array_equal(cut_out(volume, (2, 3)), volume[:, 2:5, 3:6])
    assert cut_out(volume, (0, 0)) is volume

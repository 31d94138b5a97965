"""Each baseline does what it is known for, on a scan of the pins small enough for any machine."""

import numpy as np
import pytest
import torch

from tomo_polysplat.baselines.arrays.fdk import fdk
from tomo_polysplat.baselines.arrays.limar import limar
from tomo_polysplat.baselines.arrays.metal_trace import find_metal, forward_project
from tomo_polysplat.baselines.arrays.mono_splat import mono_splat
from tomo_polysplat.baselines.arrays.nmar import nmar
from tomo_polysplat.baselines.arrays.sirt import sirt
from tomo_polysplat.baselines.arrays.voxel_poly import voxel_poly
from tomo_polysplat.baselines.arrays.water_bhc import water_bhc
from tomo_polysplat.result.metrics import compare
from tomo_polysplat.scan.geometry import VolumeGrid, from_astra, projections_from_astra
from tomo_polysplat.simulate.scenes import simulate_scan
from tomo_polysplat.start import fdk as start_fdk


def load(scan):
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    return projections_from_astra(scan.projections, scan.proj_geom), geometry, grid


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    """Tensors this small are not worth sharing out, least of all over busy cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def scan():
    return simulate_scan("pins", 32, 60)


@pytest.fixture(scope="module")
def data(scan):
    return load(scan)


@pytest.fixture(scope="module")
def psnr(scan):
    return lambda volume: compare(volume, scan.truth, scan.metal_mask)["psnr"]


@pytest.fixture(scope="module")
def water(scan, data):
    return water_bhc(*data, scan.spectrum)


def streaks(volume, scan):
    """Deviation from the truth within the object in slices with metal, the metal itself and its blur left out."""
    from scipy.ndimage import binary_dilation

    near = binary_dilation(scan.metal_mask, iterations=2)
    slices = scan.metal_mask.any(axis=(1, 2))[:, None, None]
    where = (scan.truth > 0.1) & slices & ~near
    assert where.sum() > 500
    return float(np.std((volume - scan.truth)[where]))


def test_fdk_bridges_rays_that_were_not_measured(data):
    projections, geometry, grid = data
    whole = start_fdk.fdk(projections, geometry, grid)
    np.testing.assert_array_equal(fdk(*data), whole)
    holed = projections.copy()
    holed[::7, 5::11, 3::9] = np.nan
    bridged = fdk(holed, geometry, grid)
    assert np.isfinite(bridged).all()
    assert 0 < np.abs(bridged - whole).mean() < 0.1 * np.abs(whole).mean()


def test_water_correction_takes_the_cupping_out_of_water():
    """A metal-free object of water-like matter: its middle is as bright as its rim, and right."""
    scan = simulate_scan("pins", 32, 60, metal=False, noise=False)
    data = load(scan)
    inside = scan.truth > 0.9 * np.median(scan.truth[scan.truth > 0.05])
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) for n in scan.truth.shape), indexing="ij")
    middle = inside & (x**2 + y**2 < 0.3**2) & (abs(z) < 0.3)
    assert middle.sum() > 100

    def bias(volume):
        return float(np.mean((volume - scan.truth)[middle]) / np.mean(scan.truth[middle]))

    assert abs(bias(water_bhc(*data, scan.spectrum))) < 0.02
    assert abs(bias(fdk(*data))) > 0.04


def test_limar_and_nmar_lower_streaks(scan, data, psnr):
    raw = fdk(*data)
    for method in (limar, nmar):
        for spectrum in (None, scan.spectrum):
            volume = method(*data, spectrum)
            assert streaks(volume, scan) < 0.6 * streaks(raw, scan), method.__name__
            assert psnr(volume) > psnr(raw) + 4


def test_nmar_keeps_what_interpolation_blurs():
    """Bone beside metal: the prior carries it through the trace that plain interpolation flattens."""
    scan = simulate_scan("teeth", 32, 60)
    data = load(scan)
    errors = {f: compare(f(*data, scan.spectrum), scan.truth, scan.metal_mask)["psnr"] for f in (limar, nmar)}
    assert errors[nmar] > errors[limar] + 0.1


def test_the_metal_trace_is_where_the_metal_casts_its_shadow(scan, data):
    metal = find_metal(*data)
    shadow = forward_project(scan.metal_mask.astype(np.float32), *data[1:]) > 0.5 * data[2].voxel_size.min()
    assert 0 < metal.mask.sum() < 3 * scan.metal_mask.sum()
    assert (metal.rays & shadow).sum() > 0.5 * shadow.sum()
    assert metal.rays.mean() < 0.1


def test_no_metal_leaves_water_corrected_fdk(caplog):
    scan = simulate_scan("pins", 32, 60, metal=False)
    data = load(scan)
    expected = water_bhc(*data, scan.spectrum)
    assert not find_metal(*data).mask.any()
    for method in (limar, nmar):
        caplog.clear()
        np.testing.assert_allclose(method(*data, scan.spectrum), expected, atol=1e-6)
        assert "No metal" in caplog.text


def test_sirt_explains_the_projections(data):
    projections, geometry, grid = data
    volume = sirt(projections, geometry, grid, iterations=6)
    again = forward_project(volume, geometry, grid)
    assert volume.min() >= 0
    assert np.sqrt(np.mean((again - projections) ** 2)) < 0.35 * np.sqrt(np.mean(projections**2))


def test_polychromatic_voxels_beat_water_correction(scan, data, psnr, water):
    seen = []
    volume = voxel_poly(*data, scan.spectrum, settings={"passes": 4.0}, callbacks=[seen.append])
    assert psnr(volume) > psnr(water) + 8
    assert [state.iteration for state in seen] == [15, 30, 45, 60]
    assert seen[-1].held_out < 0.6 * seen[0].held_out
    np.testing.assert_allclose(seen[-1].volume(), volume, rtol=1e-5)


def test_voxels_keep_to_a_unit_and_a_budget(scan, data):
    projections, geometry, grid = data
    settings = {"passes": 1.0}
    in_cm = voxel_poly(projections, geometry, grid, scan.spectrum, settings=settings)
    in_mm = voxel_poly(
        projections, geometry.scaled(10), grid.scaled(10), scan.spectrum, unit="mm", settings=settings
    )
    # A voxel at an edge may follow a rounding; a wrong unit would change all of them.
    assert np.linalg.norm(10 * in_mm - in_cm) < 3e-3 * np.linalg.norm(in_cm)
    seen = []
    voxel_poly(*data, scan.spectrum, time_budget=1e-3, callbacks=[seen.append])
    assert not seen
    voxel_poly(*data, scan.spectrum, callbacks=[lambda state: seen.append(state) or True])
    assert len(seen) == 1


def test_voxels_of_one_slice_without_dense_matter():
    scan = simulate_scan("pins", 33, 50, metal=False, geometry="fan")
    data = load(scan)
    volume = voxel_poly(*data, scan.spectrum, settings={"passes": 3.0})
    assert volume.shape == (1, 33, 33)
    assert (
        compare(volume, scan.truth)["psnr"] > compare(water_bhc(*data, scan.spectrum), scan.truth)["psnr"] - 1
    )


def test_mono_splat_knows_one_energy(scan, data):
    result = mono_splat(*data, progress=False, settings={"passes": 1.0})
    assert result.is_monochromatic
    assert result.volume.shape == scan.truth.shape
    soft = (scan.truth > 0.1) & ~scan.metal_mask
    assert result.volume[soft].mean() == pytest.approx(scan.truth[soft].mean(), rel=0.3)


def test_an_unsuitable_grid_is_refused_in_words(data):
    projections, geometry, grid = data
    aside = VolumeGrid(grid.shape, grid.lower + 50, grid.upper + 50)
    with pytest.raises(ValueError, match="filtered backprojection does not fit"):
        fdk(projections, geometry, aside)

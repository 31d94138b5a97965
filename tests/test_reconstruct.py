"""Reconstructions against truths, references and each other."""

from functools import cache

import astra
import numpy as np
import pytest
from small_scans import QUICK, cone, fan, in_two_dimensions, reconstruct, relative, scaled, window

import tomo_polysplat as tps
from tomo_polysplat.plan.answer import Status
from tomo_polysplat.plan.order import ORDER
from tomo_polysplat.result.metrics import compare
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.simulate.scanner import Scanner
from tomo_polysplat.simulate.scenes import scan_phantom, scene_phantom
from tomo_polysplat.start.fdk import fdk

SPECTRA_ARE_DOUBTED = True  # see tests/conftest.py

ALL_BUT_ROUNDING = 1e-5
FAST = {"quality": "fast", "settings": {"views_per_step": 4}}


@pytest.fixture(scope="module")
def metal_scan():
    return cone(28, 55, metal=True)


@pytest.fixture(scope="module")
def metal_result(metal_scan):
    scan = metal_scan
    return tps.reconstruct(
        scan.projections,
        scan.proj_geom,
        scan.vol_geom,
        spectrum=scan.spectrum,
        valid=scan.valid,
        **FAST,
    )


def psnr(volume, scan):
    return compare(volume, scan.truth, scan.metal_mask)["psnr"]


@pytest.mark.parametrize("filter_name", ["ram-lak", "hann"])
def test_metal_leaves_fewer_artefacts_than_filtered_backprojection(metal_scan, metal_result, filter_name):
    geometry, grid = from_astra(metal_scan.proj_geom, metal_scan.vol_geom)
    projections = projections_from_astra(metal_scan.projections, metal_scan.proj_geom)
    volume = fdk(projections, geometry, grid, filter_name=filter_name)
    assert psnr(metal_result.volume, metal_scan) > psnr(volume, metal_scan) + 6


def test_the_spectrum_is_what_removes_them(metal_scan, metal_result):
    mono = reconstruct(metal_scan, spectrum=None, valid=metal_scan.valid, **FAST)
    assert psnr(metal_result.volume, metal_scan) > psnr(mono.volume, metal_scan) + 1


def test_metal_itself_has_its_attenuation(metal_scan, metal_result):
    """Pins thinner than two voxels: their mass, not their height, is what the scan tells."""
    around = metal_scan.truth > 2
    assert metal_result.volume[around].sum() == pytest.approx(metal_scan.truth[around].sum(), rel=0.25)


def test_attenuation_at_the_effective_energy_is_the_volume(metal_result):
    energy = metal_result.energy_kev
    assert energy == metal_result.spectrum.effective_energy
    assert relative(metal_result.attenuation(energy), metal_result.volume) < ALL_BUT_ROUNDING
    soft = (metal_result.volume > 0.1) & (metal_result.volume < 0.4)
    below, above = (metal_result.attenuation(energy + d)[soft].mean() for d in (-10, 10))
    assert below > metal_result.volume[soft].mean() > above


def test_the_plan_and_the_counts_say_what_was_done(metal_result, metal_scan):
    facts = {"model", "dimensions", "start", "kernel", "spectrum", "reference_energy", "gaussians", "stop"}
    assert {kind.name for kind in ORDER} | facts | {"photons_per_ray", "memory"} <= set(metal_result.plan)
    for name, answer in metal_result.plan.items():
        assert answer.why or answer.status is Status.FOUND, f"{name}: {answer} gives no reason"
    counts = metal_result.counts
    assert counts["rays"] == metal_scan.projections.size and counts["pairs_skipped_at_source"] == 0
    assert counts["gaussians"] == len(metal_result.gaussians["density"]) > 1000
    assert metal_result.settings["seed"] == 0 and metal_result.settings["quality"] == "fast"


def test_the_history_tells_speed_against_error(metal_result):
    seconds = [record["seconds"] for record in metal_result.history]
    assert len(seconds) >= 2 and seconds == sorted(seconds) and seconds[-1] <= metal_result.seconds
    assert metal_result.history[-1]["held_out"] < metal_result.history[0]["held_out"]


@pytest.fixture(scope="module")
def mono_scan():
    spectrum = tps.Spectrum.monochromatic(60.0)
    return tps.simulate_scan("pins", 48, 60, geometry="fan", metal=False, spectrum=spectrum)


def test_a_monochromatic_scan_needs_no_spectrum(mono_scan):
    result = reconstruct(mono_scan, spectrum=None, settings={"passes": 5.0, "views_per_step": 4})
    assert result.energy_kev is None and result.is_monochromatic
    assert psnr(result.volume, mono_scan) > 18
    inside = mono_scan.truth > 0.15
    assert result.volume[inside].mean() == pytest.approx(mono_scan.truth[inside].mean(), rel=0.03)


def test_a_spectrum_of_one_energy_adds_that_energy_and_nothing_else(mono_scan):
    without, stated = reconstruct(mono_scan, spectrum=None), reconstruct(mono_scan)
    assert np.array_equal(without.volume, stated.volume)
    assert stated.energy_kev == 60.0 and np.array_equal(stated.attenuation(60.0), stated.volume)


LENGTHS = [(10.0, "mm"), (1e4, "um"), (1e-2, "m"), (1e-3, "cm"), (1e3, "cm")]


@cache
def in_centimetres(polychromatic):
    return reconstruct(fan(), spectrum=fan().spectrum if polychromatic else None).volume


@pytest.mark.parametrize("factor, unit", LENGTHS)
@pytest.mark.parametrize("polychromatic", [True, False], ids=["spectrum", "no spectrum"])
def test_any_unit_gives_the_same_volume(factor, unit, polychromatic):
    scan = fan()
    spectrum = scan.spectrum if polychromatic else None
    expected = in_centimetres(polychromatic)
    # A density that no matter has is as good as any where it is not refused.
    settings = QUICK | {"density_check": "warn"}
    result = reconstruct(scan, None, *scaled(scan, factor), unit=unit, spectrum=spectrum, settings=settings)
    assert relative(result.volume * factor, expected) < 1e-3
    assert result.unit == unit


def test_pixels_are_a_unit_without_a_spectrum():
    scan = fan()
    expected = in_centimetres(False)
    voxel = 5 / 48
    result = reconstruct(scan, None, *scaled(scan, 1 / voxel), unit="pixel", spectrum=None)
    assert relative(result.volume / voxel, expected) < 1e-3


def asymmetric_image():
    """A disc with a block at the upper left, row 0 at +y as in ASTRA's 2D images."""
    y, x = np.meshgrid(np.arange(40) - 19.5, np.arange(40) - 19.5, indexing="ij")
    image = np.where(x**2 + y**2 < 17**2, 0.02, 0.0)
    image[8:14, 10:20] = 0.05
    return image.astype(np.float32)


@pytest.mark.parametrize("kind", ["parallel", "fanflat", "fanflat_vec"])
def test_two_dimensional_images_come_as_astra_has_them(kind):
    """Projections by ASTRA itself of an image without symmetry."""
    image, angles = asymmetric_image(), np.linspace(0, 2 * np.pi, 60, endpoint=False)
    vol_geom = astra.create_vol_geom(40, 40)
    if kind == "parallel":
        proj_geom = astra.create_proj_geom("parallel", 1.0, 60, angles)
    else:
        proj_geom = astra.create_proj_geom("fanflat", 1.5, 60, angles, 100.0, 50.0)
    projector = astra.create_projector("line" if kind == "parallel" else "line_fanflat", proj_geom, vol_geom)
    number, sinogram = astra.create_sino(image, projector)
    astra.data2d.delete(number)
    astra.projector.delete(projector)
    if kind == "fanflat_vec":
        proj_geom = astra.geom_2vec(proj_geom)
    settings = {"passes": 4.0, "views_per_step": 4}
    result = tps.reconstruct(sinogram, proj_geom, vol_geom, unit="pixel", settings=settings)
    assert result.volume.shape == image.shape
    errors = {
        name: float(np.abs(np.asarray(result.volume) - other).mean())
        for name, other in {
            "same": image,
            "up-down": image[::-1],
            "left-right": image[:, ::-1],
            "transposed": image.T,
        }.items()
    }
    assert errors["same"] < 0.5 * min(error for name, error in errors.items() if name != "same")
    assert errors["same"] < 0.1 * 0.02


def test_one_row_and_the_same_in_two_dimensions_agree():
    scan = fan()
    volume = reconstruct(scan).volume
    seen = []
    flat = reconstruct(scan, *in_two_dimensions(scan), callbacks=[lambda state: seen.append(state.volume())])
    assert volume.shape == (1, 48, 48) and flat.volume.shape == seen[0].shape == (48, 48)
    assert relative(flat.volume, volume[0, ::-1]) < 1e-3
    assert relative(seen[-1], flat.volume) < ALL_BUT_ROUNDING


@pytest.mark.parametrize("geometry", ["cone", "parallel"])
def test_vectors_say_the_same_as_angles(geometry):
    scan = cone() if geometry == "cone" else tps.simulate_scan("pins", 20, 40, geometry="parallel")
    vectors = astra.geom_2vec(scan.proj_geom)
    assert vectors["type"].endswith("_vec") and not scan.proj_geom["type"].endswith("_vec")
    pair = [reconstruct(scan, proj_geom=g, spectrum=None) for g in (scan.proj_geom, vectors)]
    assert relative(pair[0].volume, pair[1].volume) < 1e-3


def turned_about_x(proj_geom, degrees):
    """The whole scanner turned about x, so that its axis of rotation is no longer z."""
    vectors, angle = astra.geom_2vec(proj_geom), np.deg2rad(degrees)
    turn = np.array([[1, 0, 0], [0, np.cos(angle), -np.sin(angle)], [0, np.sin(angle), np.cos(angle)]])
    vectors["Vectors"] = (vectors["Vectors"].reshape(-1, 4, 3) @ turn.T).reshape(-1, 12)
    return vectors


SCANNERS = {
    "straight": lambda p, v: (p, v),
    "tilted": lambda p, v: (turned_about_x(p, 20), v),
    "flat voxels": lambda p, v: (p, astra.create_vol_geom(24, 24, 5, *window(v))),
    "narrow voxels": lambda p, v: (p, astra.create_vol_geom(24, 8, 24, *window(v))),
    "offset window": lambda p, v: (p, astra.create_vol_geom(24, 24, 24, -2.2, 2.8, -2.7, 2.3, -2.4, 2.6)),
    "flat pixels": lambda p, v: (p | {"DetectorRowCount": 12, "DetectorSpacingY": 0.92}, v),
    "one row, many slices": lambda p, v: (
        p | {"DetectorRowCount": 1},
        astra.create_vol_geom(24, 24, 3, *window(v)[:4], -0.3, 0.3),
    ),
}


@pytest.mark.parametrize("name", SCANNERS)
def test_any_scanner_and_any_voxels(name):
    """The attenuation of what is certainly seen, whatever the shapes of pixels and voxels."""
    proj_geom, vol_geom = SCANNERS[name](cone().proj_geom, cone().vol_geom)
    scan = scan_phantom(
        scene_phantom("pins", False), proj_geom, vol_geom, cone().spectrum, Scanner(noise=False)
    )
    result = reconstruct(scan, settings={"passes": 3.0, "views_per_step": 5})
    _, grid = from_astra(proj_geom, vol_geom)
    z, y, x = np.meshgrid(*grid.axes()[::-1], indexing="ij")
    core = (np.hypot(x, y) < 1.6) & (np.abs(z) < (0.1 if name.startswith("one row") else 0.9))
    assert core.sum() > 50
    error = np.abs(result.volume - scan.truth)[core].mean() / scan.truth[core].mean()
    assert error < 0.12
    assert result.volume[core].mean() == pytest.approx(scan.truth[core].mean(), rel=0.05)


def test_two_slices_and_no_warnings_from_numpy(recwarn):
    scan = cone(metal=True)
    vol_geom = astra.create_vol_geom(24, 24, 2, *window(scan.vol_geom)[:4], -0.2, 0.2)
    result = reconstruct(scan, vol_geom=vol_geom, settings=QUICK)
    assert result.volume.shape == (2, 24, 24) and np.isfinite(result.volume).all()
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]

"""The named scenes."""

import numpy as np
import pytest

from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.simulate.orbit import view_vectors
from tomo_polysplat.simulate.phantom import Part, Phantom
from tomo_polysplat.simulate.scanner import Scanner
from tomo_polysplat.simulate.scenes import SCENES, scan_phantom, scene_phantom, simulate_scan
from tomo_polysplat.simulate.shapes import ellipsoid

QUICK = {"size": 15, "views": 3}


@pytest.mark.parametrize("scene", SCENES)
def test_a_scene_fits_its_volume_and_its_control_has_no_metal(scene):
    phantom = scene_phantom(scene)
    half = SCENES[scene].half_width
    for part in phantom.parts:
        assert np.all(np.abs(part.shape.centre) + part.shape.half_extent <= half)
    metals = {part.material for part in phantom.parts if part.metal and part.density > 0}
    assert metals == {SCENES[scene].metal}
    control = scene_phantom(scene, metal=False)
    assert not any(part.metal for part in control.parts)
    assert not metals & set(control.materials)
    assert len(control.parts) < len(phantom.parts)


@pytest.mark.parametrize("scene", SCENES)
def test_scans_with_and_without_metal(scene):
    scan, control = (simulate_scan(scene, **QUICK, metal=metal) for metal in (True, False))
    assert scan.projections.shape == (23, 3, 23) and scan.projections.dtype == np.float32
    assert scan.truth.shape == scan.metal_mask.shape == (15, 15, 15)
    assert np.isfinite(scan.projections).all() and np.isfinite(scan.truth).all()
    assert scan.metal_mask.any() and not control.metal_mask.any()
    # The metal replaces what the control has there, and nothing else differs.
    np.testing.assert_array_equal(scan.truth[~scan.metal_mask], control.truth[~scan.metal_mask])
    assert scan.truth.max() > 3 * control.truth.max()
    assert scan.truth_energy_kev == pytest.approx(scan.spectrum.effective_energy)
    assert scan.name.startswith(scene) and control.name == f"{scene}-control"


def test_texture_is_fine_and_part_of_the_object():
    assert len(scene_phantom("broccoli").parts) > 500
    first, second = (simulate_scan("broccoli", **QUICK, seed=seed, noise=False) for seed in (0, 1))
    np.testing.assert_array_equal(first.projections, second.projections)
    np.testing.assert_array_equal(first.truth, second.truth)


def test_seed_makes_a_scan_reproducible():
    first, again, other = (simulate_scan("pins", **QUICK, seed=seed).projections for seed in (7, 7, 8))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_another_metal():
    iron, titanium = (
        simulate_scan("teeth", **QUICK, metal=metal, noise=False) for metal in ("iron", "titanium")
    )
    np.testing.assert_array_equal(iron.metal_mask, titanium.metal_mask)
    assert titanium.truth.max() < iron.truth.max()
    assert np.all(titanium.projections <= iron.projections + 1e-5)


def test_projections_are_beer_lambert_over_the_spectrum():
    """One pixel of a scene, worked out by hand from its path lengths."""
    scan = simulate_scan("pancreas", **QUICK, noise=False)
    _, vectors = view_vectors(scan.proj_geom)
    source, corner, u, v = vectors[1]
    pixel = corner + 12 * v + 9 * u
    phantom = scene_phantom("pancreas")
    areal = phantom.areal_density(source[None], (pixel - source)[None], start=0.0, stop=1.0)[0]
    exponent = sum(
        a * mass_attenuation(name, scan.spectrum.energies) for a, name in zip(areal, phantom.materials)
    )
    expected = -np.log((scan.spectrum.weights * np.exp(-exponent)).sum())
    assert expected > 0.3
    assert scan.projections[12, 1, 9] == pytest.approx(expected, rel=1e-5)


def test_one_energy_integrates_the_truth():
    """Without a spectrum a parallel view's sum times the pixel area is the integral of the truth."""
    scan = simulate_scan(
        "teeth",
        40,
        2,
        geometry="parallel",
        rows=120,
        columns=120,
        spectrum=Spectrum.monochromatic(60.0),
        noise=False,
    )
    area = scan.proj_geom["DetectorSpacingX"] * scan.proj_geom["DetectorSpacingY"]
    voxel = (2 * SCENES["teeth"].half_width / 40) ** 3
    total = scan.projections.sum(axis=(0, 2), dtype=float) * area
    np.testing.assert_allclose(total, scan.truth.sum(dtype=float) * voxel, rtol=1e-2)


def test_sub_rays_average_intensities():
    """The mean transmission over a pixel never exceeds that of the mean path, by Jensen's inequality."""
    ball = Phantom([Part(ellipsoid((0, 0, 0), 1.0), "iron", 7.87)])
    base = simulate_scan("pins", 9, 1)
    scanner, spectrum = Scanner(noise=False), Spectrum.monochromatic(60.0)
    fine_geom = {**base.proj_geom, "DetectorRowCount": 42, "DetectorColCount": 42}
    fine_geom.update(DetectorSpacingX=base.proj_geom["DetectorSpacingX"] / 3)
    fine_geom.update(DetectorSpacingY=base.proj_geom["DetectorSpacingY"] / 3)
    fine = (
        scan_phantom(ball, fine_geom, base.vol_geom, spectrum, scanner)
        .projections[:, 0]
        .reshape(14, 3, 14, 3)
    )
    coarse = scan_phantom(ball, base.proj_geom, base.vol_geom, spectrum, scanner, subrays=3).projections[:, 0]
    np.testing.assert_allclose(
        coarse, -np.log(np.exp(-fine.astype(float)).mean(axis=(1, 3))), rtol=1e-4, atol=1e-5
    )
    assert np.any(coarse < fine.mean(axis=(1, 3)) - 0.1)


@pytest.mark.parametrize("size, rows, columns", [(1, None, None), (7, 5, 16), (13, None, 9)])
def test_odd_sizes(size, rows, columns):
    scan = simulate_scan("lung", size, 2, rows=rows, columns=columns)
    assert scan.projections.shape == (rows or -(-3 * size // 2), 2, columns or -(-3 * size // 2))
    assert scan.truth.shape == (size,) * 3


def test_size_samples_the_same_object():
    """A coarse scan's rays are among those of a scan with three times the pixels."""
    coarse = simulate_scan("pepper", 8, 2, rows=11, columns=11, noise=False)
    fine = simulate_scan("pepper", 24, 2, rows=33, columns=33, noise=False)
    np.testing.assert_allclose(coarse.projections, fine.projections[1::3, :, 1::3], atol=1e-5)
    mean = fine.truth.reshape(8, 3, 8, 3, 8, 3).mean(axis=(1, 3, 5))
    assert np.abs(coarse.truth - mean).mean() < 0.02 * coarse.truth.max()


def test_fan_is_the_middle_of_the_cone():
    fan = simulate_scan("lung", 15, 4, geometry="fan", columns=21, noise=False)
    cone = simulate_scan("lung", 15, 4, rows=21, columns=21, noise=False)
    assert fan.projections.shape == (1, 4, 21) and fan.truth.shape == (1, 15, 15)
    np.testing.assert_allclose(fan.projections[0], cone.projections[10], atol=1e-5)


@pytest.mark.parametrize("scene", SCENES)
def test_the_plane_of_a_fan_cuts_the_metal(scene):
    scan = simulate_scan(scene, 24, 1, geometry="fan", noise=False)
    assert 1 < scan.metal_mask.sum() < 0.1 * scan.metal_mask.size


@pytest.mark.parametrize(
    "wrong, words",
    [
        ({"scene": "tooth"}, "pins, teeth, lung"),
        ({"size": 0}, "size"),
        ({"size": 9.5}, "whole number"),
        ({"views": -1}, "views"),
        ({"geometry": "spiral"}, "geometry"),
        ({"metal": "unobtainium"}, "unobtainium"),
        ({"subrays": 0}, "subrays"),
        ({"arc_degrees": 0.0}, "arc_degrees"),
    ],
)
def test_mistakes_are_named(wrong, words):
    with pytest.raises(ValueError, match=words):
        simulate_scan(**{"scene": "pins", "size": 9, "views": 2, **wrong})

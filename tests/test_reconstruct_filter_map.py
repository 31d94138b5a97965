"""Scans behind a bowtie, through the public calls."""

from functools import cache

import astra
import numpy as np
import pytest
import small_scans

import tomo_polysplat as tps
from tomo_polysplat.cli.main import main
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.filter_shape import bowtie_map
from tomo_polysplat.physics.materials import density, mass_attenuation
from tomo_polysplat.plan import bowtie
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.bowtie import find_bowtie
from tomo_polysplat.plan.preparation import RunOptions
from tomo_polysplat.report.decided import found_about_the_scanner
from tomo_polysplat.result.filter_found import filter_of
from tomo_polysplat.scan.filter_map_file import thickness_of
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.io import load_scan, save_scan
from tomo_polysplat.scan.scan import Scan

SPECTRUM = tps.Spectrum.from_tube(70, filters={"Al": 0.05})
COLUMNS, VIEWS, HALF = 61, 60, 0.5
BOWTIE = ((np.arange(COLUMNS) - 30) / 30) ** 2
# Discs of bone in a disc of water: places and radii in half widths.
DISCS = (
    (0.5, 0.2, 0.2),
    (-0.4, 0.45, 0.15),
    (-0.3, -0.5, 0.22),
    (0.25, -0.45, 0.12),
    (0.05, 0.6, 0.1),
    (-0.1, 0.05, 0.1),
)


def disc(bowtie):
    """Bone in water, one row of a parallel beam in closed form, behind so many cm of aluminium."""
    width = 2.4 * HALF / COLUMNS
    geometry = astra.create_proj_geom(
        "parallel3d", width, width, 1, COLUMNS, np.arange(VIEWS) * np.pi / VIEWS
    )
    window = (-HALF, HALF, -HALF, HALF, -width / 2, width / 2)
    across = (np.arange(COLUMNS) - 30) * width
    outer, inner = (2 * HALF * np.sqrt(np.clip(r**2 - (across / HALF) ** 2, 0, None)) for r in (0.9, 0.4))
    curves = np.stack([mass_attenuation(m, SPECTRUM.energies) for m in ("water", "bone", "Al")])
    paths = np.stack([outer - inner, 1.9 * inner, density("Al") * bowtie])
    logs = np.log(np.maximum(SPECTRUM.weights, 1e-30))
    row = projection(paths, logs, curves) - projection(paths * [[0], [0], [1]], logs, curves)
    values = np.broadcast_to(row, (1, VIEWS, COLUMNS)).astype(np.float32)
    return Scan(values, geometry, astra.create_vol_geom(45, 45, 1, *window), spectrum=SPECTRUM)


def discs(thickest):
    """As `disc`, of several discs of bone, behind so many cm of aluminium at the sides."""
    width, angles = 2.4 * HALF / COLUMNS, np.arange(VIEWS) * np.pi / VIEWS
    geometry = astra.create_proj_geom("parallel3d", width, width, 1, COLUMNS, angles)
    across = (np.arange(COLUMNS) - 30) * width

    def chord(x, y, radius):
        place = HALF * (x * np.cos(angles) + y * np.sin(angles))
        return 2 * np.sqrt(np.clip((HALF * radius) ** 2 - (across - place[:, None]) ** 2, 0, None))

    bone = sum(chord(*one) for one in DISCS)
    curves = np.stack([mass_attenuation(m, SPECTRUM.energies) for m in ("water", "bone", "Al")])
    filters = np.broadcast_to(density("Al") * thickest * BOWTIE, bone.shape)
    paths = np.stack([chord(0, 0, 0.9) - bone, 1.9 * bone, filters]).reshape(3, -1)
    logs = np.log(np.maximum(SPECTRUM.weights, 1e-30))
    values = projection(paths, logs, curves) - projection(paths * [[0], [0], [1]], logs, curves)
    window = (-HALF, HALF, -HALF, HALF, -width / 2, width / 2)
    volume = astra.create_vol_geom(45, 45, 1, *window)
    return Scan(values.reshape(1, VIEWS, COLUMNS).astype(np.float32), geometry, volume, spectrum=SPECTRUM)


def bias(result):
    """Of water, and of bone, relative."""
    volume = np.asarray(result.volume).reshape(45, 45)
    place = (np.arange(45) - 22) / 22.5
    radius = np.hypot(place, place[:, None])
    parts = ("water", (radius > 0.5) & (radius < 0.8), 1.0), ("bone", radius < 0.3, 1.9)
    truth = [grams * mass_attenuation(material, SPECTRUM.effective_energy) for material, _, grams in parts]
    return np.array([volume[inside].mean() / value - 1 for (_, inside, _), value in zip(parts, truth)])


def reconstructed(scan, **options):
    # Where the scanner stood, and whether it scattered, is asked in other files.
    settings = {"passes": 6.0, "views_per_step": 20}
    return tps.reconstruct(scan, settings=settings, align=False, calibrate=False, **options)


@cache
def told():
    """A scan whose bowtie is told, and what is made of it."""
    scan = disc(BOWTIE)
    scan.filter_map = ("Al", BOWTIE)
    return scan, reconstructed(scan)


def test_a_bowtie_that_is_told_does_no_harm():
    plain, untold, found = reconstructed(disc(0 * BOWTIE)), reconstructed(disc(BOWTIE)), told()[1]
    off = np.abs(bias(found) - bias(plain))
    assert off.max() < 0.03, (bias(found), bias(plain))
    assert np.abs(bias(untold)).max() > 5 * off.max(), "the bowtie must be thick enough to matter"
    assert "cm of Al" in found.plan["filter_map"].why


def test_the_report_and_the_usual_methods_know_of_it(tmp_path):
    from tomo_polysplat.baselines.of_scan import water_bhc
    from tomo_polysplat.report.residuals import residuals_of

    behind, result = told()
    untold = bias(water_bhc(disc(BOWTIE)))
    np.testing.assert_allclose(bias(water_bhc(behind))[0], bias(water_bhc(disc(0 * BOWTIE)))[0], atol=0.02)
    assert untold[0] < bias(water_bhc(behind))[0] - 0.05
    wrong = Scan(behind.projections, behind.proj_geom, behind.vol_geom, spectrum=SPECTRUM)
    assert residuals_of(result, behind).rms < 0.3 * residuals_of(result, wrong).rms


@pytest.mark.parametrize("ending", ["npz", "h5"])
def test_files_and_their_parts_carry_it(tmp_path, ending):
    scan = disc(BOWTIE)
    scan.filter_map = ("Al", np.stack([BOWTIE]), 2.6)
    save_scan(scan, tmp_path / f"scan.{ending}")
    material, thickness, grams = load_scan(tmp_path / f"scan.{ending}").filter_map
    assert (material, grams) == ("Al", 2.6)
    np.testing.assert_allclose(thickness, BOWTIE[None], rtol=1e-6)
    part = load_scan(tmp_path / f"scan.{ending}", columns=(10, 50))
    np.testing.assert_allclose(part.filter_map[1], BOWTIE[None, 10:50], rtol=1e-6)


def test_the_command_line_takes_it(tmp_path):
    scan = disc(BOWTIE)
    save_scan(scan, tmp_path / "scan.npz")
    np.savetxt(tmp_path / "bowtie.txt", BOWTIE[None])
    asked = ["recon", str(tmp_path / "scan.npz"), "-o", str(tmp_path / "out.npy"), "--set", "passes=1"]
    asked += ["--set", "views_per_step=20", "--no-align", "--no-calibrate"]
    assert (
        main([*asked, "--filter-map", f"Al:{tmp_path / 'bowtie.txt'}", "--json", str(tmp_path / "plan.json")])
        == 0
    )
    assert "cm of Al" in (tmp_path / "plan.json").read_text()
    assert main([*asked, "--filter-map", "Al", "--overwrite"]) == 2


def test_one_energy_is_dimmed_and_not_hardened():
    scan = disc(BOWTIE)
    quick = {"settings": small_scans.QUICK}
    parts = (scan.projections, scan.proj_geom, scan.vol_geom)
    alone = tps.reconstruct(*parts, **quick)
    same = tps.reconstruct(*parts, filter_map=("Al", BOWTIE), **quick)
    np.testing.assert_array_equal(np.asarray(alone.volume), np.asarray(same.volume))


def test_one_that_is_found_is_as_one_that_is_told(monkeypatch, tmp_path):
    found = Answer({"parabola": 1.0}, "as planted", Status.ASKED)
    monkeypatch.setattr("tomo_polysplat.plan.solver.find_bowtie", lambda *_: found)
    scan = disc(BOWTIE)
    quick = {"settings": small_scans.QUICK, "align": False}
    path = tmp_path / "checkpoint.npz"
    by_fit = tps.reconstruct(scan, filter_map="fit", checkpoint=path, **quick)
    same = bowtie_map(found.value, 1, COLUMNS)
    told = tps.reconstruct(scan, filter_map=same, **quick)
    np.testing.assert_array_equal(np.asarray(by_fit.volume), np.asarray(told.volume))
    assert by_fit.plan[
        "bowtie"
    ] is found and "a bowtie of aluminium in cm, parabola 1" in found_about_the_scanner(by_fit.plan)
    np.testing.assert_array_equal(filter_of(by_fit, scan)[1], same[1])
    monkeypatch.undo()
    again = tps.reconstruct(scan, filter_map="fit", checkpoint=path, resume=True, **quick)
    assert again.plan["bowtie"].value == found.value, "a checkpoint knows it"


def test_what_cannot_be_found_is_refused():
    scan = disc(BOWTIE)
    with pytest.raises(ValueError, match="time_budget"):
        tps.reconstruct(scan, filter_map="fit", time_budget=5)
    with pytest.raises(ValueError, match="filter_map"):
        tps.reconstruct(scan, filter_map="auto")


def test_fits_find_a_bowtie_of_grains_and_none_where_there_is_none(monkeypatch):
    """A slice of discs that lie anywhere: no ring of the object does what the bowtie does."""
    monkeypatch.setattr(bowtie, "_BATCH", 6)  # two thirds of the steps
    for thickness, least, most in ((1.0, 0.6, 1.5), (0.0, 0.0, 0.2)):
        scan = discs(thickness)
        geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
        values = np.ascontiguousarray(np.moveaxis(scan.projections, 1, 0))
        problem = Problem.of(values, geometry, grid, "cm", SPECTRUM, None)
        options = RunOptions.of("balanced", {"views_per_step": 10}, None, 0, "cpu", [])
        answer = find_bowtie(problem, options, lambda *_: None)
        assert least <= answer.evidence["thickest"] <= most, answer


def test_one_row_of_numbers_stands_for_all_in_any_file(tmp_path):
    row = np.linspace(0.0, 2.0, 7)
    np.save(tmp_path / "row.npy", row)
    np.save(tmp_path / "rows.npy", row[None])
    np.savetxt(tmp_path / "row.txt", row[None])
    for name in ("row.npy", "rows.npy", "row.txt"):
        np.testing.assert_allclose(thickness_of(tmp_path / name, "--filter-map"), row[None])

"""The usual methods on a scan, and the comparison: what they are right about, and the table and figure of it."""

from dataclasses import replace

import numpy as np
import pytest

import tomo_polysplat as tps
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.result.metrics import compare as errors_of
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import VolumeGrid


@pytest.fixture(scope="module")
def pins():
    return tps.simulate_scan("pins", size=25, views=45, photons=1e6)


@pytest.fixture(scope="module")
def made(pins):
    names = ("fdk", "sirt", "water_bhc", "limar", "nmar")
    return {name: getattr(tps.baselines, name)(pins, device="cpu") for name in names}


@pytest.fixture(scope="module")
def outcome(pins, made):
    return tps.compare(pins.truth, made, metal=pins.metal_mask)


def test_methods_come_as_results_of_the_scan(pins, made):
    for name, one in made.items():
        assert one.volume.shape == pins.volume_shape and one.unit == pins.unit and one.seconds > 0, name
        assert one.is_monochromatic and one.provenance["scan"] == pins.name
    assert made["fdk"].energy_kev is None, "of a scan with many energies it has no known one"
    assert made["water_bhc"].energy_kev == pytest.approx(pins.spectrum.effective_energy)


def test_one_energy_needs_no_water_correction(pins, made):
    scan = replace(pins, spectrum=tps.Spectrum.monochromatic(57.0))
    same = tps.baselines.water_bhc(scan, device="cpu")
    np.testing.assert_array_equal(same.volume, made["fdk"].volume)
    assert same.energy_kev == 57.0 and same.provenance["method"] == "FDK"


def test_metal_costs_what_it_is_known_to_cost(outcome):
    """Least squares and interpolated metal traces are nearer to the truth without the metal than FDK."""
    error = {entry["name"]: entry["rmse"] for entry in outcome.table}
    assert error["sirt"] < error["fdk"] and max(error["nmar"], error["limar"]) < 0.5 * error["fdk"]
    assert error["water_bhc"] > 0.9 * error["fdk"], "water's correction does not mend metal"


def ball_of_water(radius=2.0, views=61, columns=41, rows=7):
    """A parallel scan of water under two energies, from the chords of its rays."""
    spectrum = tps.Spectrum([30.0, 80.0], [1.0, 1.0])
    pixel = 5.0 / columns
    across = (np.arange(columns) - (columns - 1) / 2) * pixel
    up = (np.arange(rows) - (rows - 1) / 2) * pixel
    chords = 2 * np.sqrt(np.maximum(radius**2 - up[:, None, None] ** 2 - across[None, None] ** 2, 0))
    values = -np.log(np.mean([np.exp(-mass_attenuation("water", e) * chords) for e in (30.0, 80.0)], axis=0))
    angles = np.linspace(0, np.pi, views, endpoint=False)
    half = 0.5 * np.array([columns, columns, rows]) * pixel
    window = {
        f"Window{end}{axis}": sign * h
        for axis, h in zip("XYZ", half)
        for end, sign in (("Min", -1), ("Max", 1))
    }
    proj_geom = {
        "type": "parallel3d",
        "DetectorSpacingX": pixel,
        "DetectorSpacingY": pixel,
        "DetectorRowCount": rows,
        "DetectorColCount": columns,
        "ProjectionAngles": angles,
    }
    vol_geom = {"GridColCount": columns, "GridRowCount": columns, "GridSliceCount": rows, "option": window}
    return tps.Scan(np.repeat(values, views, axis=1), proj_geom, vol_geom, "cm", spectrum)


def test_water_correction_is_right_for_water():
    """Cupping is gone: water has its attenuation at the effective energy, in the middle as near the edge."""
    scan = ball_of_water()
    true = mass_attenuation("water", scan.spectrum.effective_energy)
    middle, edge = (slice(18, 23), slice(18, 23)), (slice(18, 23), slice(8, 11))
    corrected = tps.baselines.water_bhc(scan, device="cpu").volume[3]
    for part in (middle, edge):
        assert corrected[part].mean() == pytest.approx(true, rel=0.02)
    plain = tps.baselines.fdk(scan, device="cpu").volume[3]
    assert corrected[middle].mean() == pytest.approx(corrected[edge].mean(), rel=0.005)
    assert plain[middle].mean() < 0.985 * plain[edge].mean()


def test_the_table_has_the_figures_of_merit(pins, made, outcome):
    expected = errors_of(made["fdk"].volume, pins.truth, pins.metal_mask)
    first = outcome.table[0]
    assert {key: first[key] for key in expected} == expected and first["seconds"] == made["fdk"].seconds
    assert "FDK (the standard)" in str(outcome) and "rms error (1/cm)" in str(outcome)
    assert outcome._repr_html_().count("<tr>") == 6


def test_the_figure_is_for_a_paper(pins, made, tmp_path):
    outcome = tps.compare(pins.truth, {name: made[name] for name in ("fdk", "nmar")}, metal=pins.metal_mask)
    outcome.save(tmp_path / "figure.pdf")
    assert (tmp_path / "figure.pdf").read_bytes().startswith(b"%PDF")
    with pytest.raises(FileExistsError):
        outcome.save(tmp_path / "figure.pdf")
    limits = {image.get_clim() for axis in outcome.figure().axes[:3] for image in axis.get_images()}
    assert len(limits) == 1, "one window for the truth and both"


def test_a_polychromatic_result_is_taken_at_the_energy_of_the_truth():
    grid = VolumeGrid((8, 9, 10), (-1, -1, -1), (1, 1, 1))
    basis = np.zeros((3, 8, 9, 10), np.float32)
    basis[0, 2:6, 2:7, 2:8] = 1.0
    result = Result(basis, grid, energy_kev=50.0, materials=tps.Materials())
    same = tps.compare(result.attenuation(70.0), {"tomo-polysplat": result}, energy_kev=70.0)
    other = tps.compare(result.attenuation(70.0), {"tomo-polysplat": result})
    assert same.table[0]["rmse"] < 1e-6 < other.table[0]["rmse"] and same.table[0]["name"] == "polysplat"


def test_mistakes_are_named(pins, made):
    with pytest.raises(TypeError, match="scan: expected a Scan, got ndarray"):
        tps.baselines.fdk(pins.projections)
    with pytest.raises(ValueError, match="scan: expected a scan with its spectrum"):
        bare = tps.Scan(pins.projections, pins.proj_geom, pins.vol_geom)
        tps.baselines.water_bhc(bare)
    with pytest.raises(ValueError, match="scan: expected a scan with a unit of length"):
        tps.baselines.water_bhc(replace(pins, unit="pixel"))
    with pytest.raises(ValueError, match="small: expected shape"):
        tps.compare(pins.truth, {"small": pins.truth[:5]})
    with pytest.raises(ValueError, match="volumes: expected a mapping"):
        tps.compare(pins.truth, made["fdk"])
    with pytest.raises(AttributeError, match="no attribute 'art'"):
        _ = tps.baselines.art

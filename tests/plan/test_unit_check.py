"""Densities that no solid has are said, once, and those of the heaviest are not."""

import logging

import numpy as np
import pytest
import torch
from small_scans import QUICK, disc

import tomo_polysplat as tps
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.physics.scatter import Scatter
from tomo_polysplat.plan.one_energy import _doubt_hardening
from tomo_polysplat.plan.unit_check import doubt_lengths, tell_impossible
from tomo_polysplat.report.decided import doubts
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.units import cm_per, density_in_doubt


def curves(density, voxels, steel=0):
    """Water, and in so many voxels metal of that density; in others steel."""
    volume = np.zeros((3, 5, 7, 9), np.float32)
    volume[0] = 1.0
    shares = np.array([[0.0], [0.25], [0.75]], np.float32)
    volume.reshape(3, -1)[:, 40 : 40 + voxels] = density * shares
    volume.reshape(3, -1)[:, 120 : 120 + steel] = 7.9 * shares
    return volume


@pytest.mark.parametrize(
    "density, voxels, steel, told",
    [(22.3, 60, 0, False), (24.0, 60, 0, True), (90.0, 2, 0, False), (28.0, 10, 150, False)],
)
def test_only_a_piece_denser_than_osmium_is_impossible(density, voxels, steel, told, caplog):
    """Some voxels of steel that overshoot are none."""
    reasons = {}
    with caplog.at_level(logging.WARNING):
        tell_impossible(curves(density, voxels, steel), reasons)
    assert ("lengths" in reasons) == told == ("What the metal is looks wrong: " in caplog.text)


@pytest.mark.parametrize("times, lightless", [(1, 0.0), (1, 0.06), (10, 0.0), (10, 0.06)])
def test_the_unit_is_doubted_only_where_the_rest_is_too_dense_as_well(times, lightless, caplog):
    """Lead through an edge of its own, in water; and steel and water in a unit ten times too short."""
    volume = curves(24.0, 60) if times == 1 else times * curves(7.9, 80)
    with caplog.at_level(logging.WARNING):
        tell_impossible(volume, {}, lightless)
    assert ("unit of length" in caplog.messages[0].partition(":")[0]) == (times == 10)
    assert ("speaks for the unit" in caplog.text) == (times == 1)


def test_rays_without_light_are_named_first(caplog):
    with caplog.at_level(logging.WARNING):
        tell_impossible(curves(80.0, 60), {}, lightless=0.06)
    assert (
        caplog.messages[0].startswith("The density of metal is not told")
        and "6.0% of the rays" in caplog.text
    )


def test_it_is_said_once(caplog):
    reasons = {}
    doubt_lengths(reasons, "of one reason")
    tell_impossible(curves(80.0, 60), reasons)
    assert len(caplog.records) == 1 and "of one reason" in reasons["lengths"].why


@pytest.mark.parametrize("unit, told", [("cm", False), ("mm", True)])
def test_iron_in_a_unit_ten_times_too_short(unit, told, caplog):
    spectrum = tps.Spectrum.from_tube(90, filters={"Al": 0.1})
    with caplog.at_level(logging.WARNING):
        result = tps.reconstruct(*disc("iron", spectrum), spectrum=spectrum, unit=unit, settings=QUICK)
    assert ("lengths" in result.plan) == told == ("which no solid has" in caplog.text)


@pytest.mark.parametrize("given, told", [({}, True), ({"unit": "cm"}, False)])
def test_lengths_of_no_unit_beside_a_spectrum_are_told(given, told, caplog):
    spectrum = tps.Spectrum.from_tube(90, filters="Al 1mm", detector="counting")
    with caplog.at_level(logging.WARNING):
        tps.reconstruct(*disc("water", spectrum), spectrum=spectrum, settings=QUICK, **given)
    assert ("lengths are taken to be in cm" in caplog.text) == told
    caplog.clear()
    tps.reconstruct(*disc("water", spectrum), settings=QUICK)
    assert "lengths are taken" not in caplog.text  # one energy: any unit will do


# What matter is in one unit and seems to be in another: densities of water that attenuates alike, at 60 keV or so.
MATTER = {
    "polymer foam": 0.03,
    "lung": 0.26,
    "wood": 0.5,
    "water": 1.0,
    "aluminium": 3.6,
    "iron": 46.0,
    "gold": 270.0,
}


@pytest.mark.parametrize("matter", MATTER)
@pytest.mark.parametrize(
    "meant, stated", [("mm", "cm"), ("um", "mm"), ("um", "cm"), ("mm", "um"), ("cm", "cm")]
)
def test_lengths_of_a_wrong_unit_are_doubted_and_the_right_one_is_named(matter, meant, stated):
    """Foam alone looks like what it is, and like a wrong unit, too."""
    level = MATTER[matter]
    found = density_in_doubt(level * cm_per(meant) / cm_per(stated), stated)
    if meant == stated:
        assert (found is not None) == (level < 0.3) and not (found and found.impossible)
        return
    seems = level * cm_per(meant) / cm_per(stated)
    assert (found is not None) == (not 0.3 <= seems <= 600)
    if found is not None:
        assert found.impossible == (not 0.005 <= seems <= 600)
        if 0.3 <= level <= 10:
            assert f"pass unit='{meant}'" in found.remedy and f"in {meant} like {level:.2g}" in found.words


def water_disc(spectrum, length):
    """The disc of water, every number of its geometry times `length`."""
    values, proj_geom, vol_geom = disc("water", spectrum)
    window = {name: edge * length for name, edge in vol_geom["option"].items()}
    proj_geom = proj_geom | {"DetectorWidth": proj_geom["DetectorWidth"] * length}
    return values, proj_geom, vol_geom | {"option": window}


@pytest.mark.parametrize("unit, stated", [("cm", "um"), ("mm", "m")])
def test_water_of_no_possible_density_is_refused_with_its_unit(unit, stated):
    spectrum = tps.Spectrum.from_tube(90, filters={"Al": 0.1})
    scan = water_disc(spectrum, 1 / cm_per(unit))
    known = {"spectrum": spectrum, "settings": QUICK}
    assert "lengths" not in tps.reconstruct(*scan, unit=unit, **known).plan
    with pytest.raises(
        ValueError, match=f"unit: .*in {stated} the object .*pass unit='{unit}'.*density_check"
    ):
        tps.reconstruct(*scan, unit=stated, **known)
    result = tps.reconstruct(
        *scan, unit=stated, spectrum=spectrum, settings=QUICK | {"density_check": "warn"}
    )
    assert "which no matter does" in result.plan["lengths"].why
    assert any("the unit of length" in doubt for doubt in doubts(result.plan))


def test_water_ten_times_too_large_is_said_and_goes_on(caplog):
    spectrum = tps.Spectrum.from_tube(90, filters={"Al": 0.1})
    with caplog.at_level(logging.WARNING):
        result = tps.reconstruct(*water_disc(spectrum, 10.0), unit="cm", spectrum=spectrum, settings=QUICK)
    assert "in mm like" in result.plan["lengths"].why and "pass unit='mm'" in caplog.text


@pytest.mark.parametrize("noise", [0.0, 0.03])
def test_nothing_but_noise_is_no_matter_of_a_wrong_unit(noise):
    """Of next to nothing any density may be told: no light is lost in it."""
    spectrum = tps.Spectrum.from_tube(90, filters={"Al": 0.1})
    values, *geometry = disc("water", spectrum)
    values = 0.002 * values + noise * np.random.default_rng(0).normal(size=values.shape)
    assert (
        "lengths" not in tps.reconstruct(values, *geometry, unit="cm", spectrum=spectrum, settings=QUICK).plan
    )


@pytest.mark.parametrize(("beam", "doubted"), [(1.0, True), (0.9, False)])
def test_rays_without_any_matter_are_told_no_polynomial(beam, doubted):
    """Faint rays are as straight as those that a scanner has corrected; under a dimmer beam none is left of them."""
    spectrum = tps.Spectrum.from_tube(90, filters={"Al": 0.1})
    values, *geometry = disc("water", spectrum)
    problem = Problem.of(0.002 * values[:, None], *from_astra(*geometry), "cm", spectrum, None)
    found = _doubt_hardening(problem.under(spectrum, Scatter(), beam), torch.device("cpu"))
    assert (found is not None) == doubted

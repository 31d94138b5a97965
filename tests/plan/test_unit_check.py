"""Densities that no solid has are said, once, and those of the heaviest are not."""

import logging

import numpy as np
import pytest
from small_scans import QUICK, disc

import tomo_polysplat as tps
from tomo_polysplat.plan.unit_check import doubt_lengths, tell_impossible


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
    assert ("lengths" in reasons) == told == ("unit of length or the size of a pixel" in caplog.text)


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

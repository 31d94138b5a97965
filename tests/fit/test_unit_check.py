"""Densities that no solid has are said, once, and those of the heaviest are not."""

import logging

import numpy as np
import pytest
from small_scans import QUICK, disc

import tomo_polysplat as tps
from tomo_polysplat.fit.unit_check import doubt_lengths, tell_impossible


def curves(density, voxels):
    """Iron beside which there is some aluminium, so many voxels of it."""
    volume = np.zeros((3, 5, 7, 9), np.float32)
    volume[0] = 1.0
    shares = np.array([[0.0], [0.25], [0.75]], np.float32)
    volume.reshape(3, -1)[:, 40 : 40 + voxels] = density * shares
    return volume


@pytest.mark.parametrize("density, voxels, told", [(22.3, 60, False), (24.0, 60, True), (90.0, 2, False)])
def test_only_a_piece_denser_than_osmium_is_impossible(density, voxels, told, caplog):
    reasons = {}
    with caplog.at_level(logging.WARNING):
        tell_impossible(curves(density, voxels), reasons)
    assert ("lengths" in reasons) == told == ("unit of length or the size of a pixel" in caplog.text)


def test_it_is_said_once(caplog):
    reasons = {}
    doubt_lengths(reasons, "of one reason")
    tell_impossible(curves(80.0, 60), reasons)
    assert len(caplog.records) == 1 and "of one reason" in reasons["lengths"]


@pytest.mark.parametrize("unit, told", [("cm", False), ("mm", True)])
def test_iron_in_a_unit_ten_times_too_short(unit, told, caplog):
    spectrum = tps.Spectrum.from_tube(90, filters={"Al": 0.1})
    with caplog.at_level(logging.WARNING):
        result = tps.reconstruct(*disc("iron", spectrum), spectrum=spectrum, unit=unit, settings=QUICK)
    assert ("lengths" in result.plan) == told == ("which no solid has" in caplog.text)

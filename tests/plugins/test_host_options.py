"""What hosts' options must be, refused before the work; and what is said of a tube without filters."""

import logging

import numpy as np
import pytest

from tomo_polysplat import polysplat
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.plugins import AstraOptions, tomopy_plugin

TUBE = {"kvp": 90, "filters": {"Al": 0.1}, "pixel_size": 0.1}


def recon(tomopy, options, **cut):
    tomo = np.full((15, 5, 21), 0.2, np.float32)
    theta = np.linspace(0, np.pi, 15, endpoint=False)
    return tomopy.recon(tomo, theta, algorithm=polysplat, options=options, **cut)


@pytest.mark.parametrize(
    "options, words",
    [
        (TUBE | {"energy_kev": 6e4}, r"options\['energy_kev'\]: expected keV between"),
        (TUBE | {"energy_kev": -4}, r"options\['energy_kev'\]: expected a finite number > 0"),
        ({"energy_kev": 60.0}, r"options\['energy_kev'\]: expected a spectrum"),
        (
            {"spectrum": Spectrum.monochromatic(60), "pixel_size": 1.0, "energy_kev": 50},
            "the spectrum's only energy",
        ),
        ({"kvp": 90}, r"options\['pixel_size'\]: expected the size of a pixel beside a spectrum"),
        (TUBE | {"on_result": 3}, "on_result.*a function"),
        (TUBE | {"time_budget": "long"}, r"options\['time_budget'\]: expected a number"),
        (TUBE | {"pixel_size": "wide"}, r"options\['pixel_size'\]: expected a number"),
        (TUBE | {"pixel_size": -1.0}, r"options\['pixel_size'\]: expected a finite number > 0"),
        ([1, 2], "options: expected a dict"),
        ("fast", "options: expected a dict"),
    ],
)
def test_a_wrong_option_is_refused_before_the_work(tomopy, solver, options, words):
    with pytest.raises((ValueError, TypeError), match=words):
        recon(tomopy, options)
    assert not solver and not tomopy_plugin._chunks._calls


@pytest.mark.parametrize("filters, told", [(None, 1), ({}, 0), ({"Al": 0.1}, 0)])
def test_a_bare_tube_is_told_once_unless_it_is_asked_for(tomopy, solver, filters, told, caplog):
    with caplog.at_level(logging.WARNING):
        recon(tomopy, TUBE | {"filters": filters}, nchunk=1, ncore=2)
    assert caplog.text.count("No filter was given") == told


def test_astras_options_tell_it_once_as_well(caplog):
    with caplog.at_level(logging.WARNING):
        options = AstraOptions(kvp=90).options
    assert caplog.text.count("No filter was given") == 1 and "kvp" not in options
    assert options["spectrum"].effective_energy < 30

"""Arguments of another kind than is meant are named, with what to pass instead."""

import logging

import numpy as np
import pytest
import torch
from small_scans import QUICK, fan, geometries, reconstruct

import tomo_polysplat as tps
from tomo_polysplat.checks import did_you_mean, require_choice
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.settings import Settings, make_settings

REFUSED = {
    "a voltage": (lambda s: {"spectrum": 90}, TypeError, "spectrum: expected a Spectrum.*from_tube"),
    "a voltage in words": (lambda s: {"spectrum": "90kVp"}, TypeError, "spectrum: expected a Spectrum"),
    "a tube as a dict": (lambda s: {"spectrum": {"kvp": 90}}, TypeError, "spectrum: expected a Spectrum"),
    "geometries exchanged": (
        lambda s: {"proj_geom": s.vol_geom, "vol_geom": s.proj_geom},
        ValueError,
        "proj_geom, vol_geom: .*exchanged",
    ),
    "a misspelt quality": (lambda s: {"quality": "balance"}, ValueError, "did you mean balanced?"),
    "a misspelt setting": (lambda s: {"settings": {"pases": 3}}, ValueError, "did you mean passes?"),
    "an unknown quality beside settings": (
        lambda s: {"quality": "superb", "settings": Settings()},
        ValueError,
        "quality: expected one of",
    ),
    "a quality beside whole settings": (
        lambda s: {"quality": "fast", "settings": Settings()},
        ValueError,
        "quality: expected none beside a Settings object",
    ),
    "one number for materials": (lambda s: {"materials": 3}, ValueError, "materials: expected three"),
    "unknown materials of one energy": (
        lambda s: {"spectrum": None, "materials": ("water", "aluminum", "irn")},
        ValueError,
        "did you mean iron",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_it_is_refused(case):
    make, error, words = REFUSED[case]
    scan = fan()
    with pytest.raises(error, match=words):
        reconstruct(scan, **make(scan))


def test_simulate_scan_wants_a_spectrum_too():
    with pytest.raises(TypeError, match="spectrum: expected a Spectrum"):
        tps.simulate_scan("pins", 8, 6, spectrum=90)


def test_whole_settings_are_taken_as_they_are():
    assert make_settings("balanced", whole := Settings(**QUICK)) is whole


@pytest.mark.parametrize(
    "value, words", [("quik", "did you mean quick?"), ("zzz", ""), (3, ""), ("q" * 10**6, "")]
)
def test_close_names_are_suggested(value, words):
    assert did_you_mean(value, ("quick", "slow")) == words
    with pytest.raises(ValueError, match="one of quick, slow") as refused:
        require_choice("speed", value, ("quick", "slow"))
    assert words in str(refused.value)


def test_a_tensor_that_has_gradients_is_an_array_like_any_other():
    scan = fan(False)
    tensor = torch.from_numpy(scan.projections.copy()).requires_grad_()
    valid = torch.from_numpy(np.ones(scan.projections.shape, bool))
    assert np.array_equal(reconstruct(scan, tensor, valid=valid).volume, reconstruct(scan).volume)


@pytest.mark.parametrize("materials, told", [(("pmma", "aluminium", "iron"), True), (None, False)])
def test_materials_that_one_energy_has_no_use_for_are_told(materials, told, caplog):
    with caplog.at_level(logging.WARNING):
        reconstruct(fan(False), spectrum=None, materials=materials)
    assert ("are not used: there is one energy" in caplog.text) == told


@pytest.mark.parametrize(
    "materials, told",
    [
        (("iron", "aluminium", "water"), True),
        (("titanium", "water", "aluminium"), True),
        (("water", "iodine", "iron"), False),
        (("iron", "copper", "gold"), False),
        (("bone", "water", "water"), False),
        (None, False),
    ],
)
def test_materials_from_dense_to_soft_are_told(materials, told, caplog):
    scan = fan(False)
    with caplog.at_level(logging.WARNING):
        Problem.of(np.moveaxis(scan.projections, 1, 0), *geometries(scan), "cm", scan.spectrum, materials)
    assert ("soft, middle, dense, in this order" in caplog.text) == told

"""A saturated camera holds one value in an area beside the object; scans that are not saturated stay as they are."""

import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.scan.counts import Counts
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.light_end import lower_end, mend_light_end
from tomo_polysplat.scan.usable import usable_rays

VIEWS, ROWS, COLUMNS, PHOTONS = 24, 12, 40, 1e4


def counts(seed=0):
    """A ball off the axis, with Poisson noise, (views, rows, columns)."""
    angles = np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)[:, None, None]
    across = np.arange(COLUMNS)[None, None] - 19.5 - 4 * np.cos(angles)
    down = np.arange(ROWS)[None, :, None] - 5.5
    chord = 2 * np.sqrt(np.clip(64 - across**2 - down**2, 0, None))
    return np.random.default_rng(seed).poisson(PHOTONS * np.exp(-0.1 * chord)), chord


def beam(angles):
    """A parallel beam of pixels of 1 cm."""
    about = {"DetectorSpacingX": 1.0, "DetectorSpacingY": 1.0, "ProjectionAngles": angles}
    return {"type": "parallel3d", "DetectorRowCount": ROWS, "DetectorColCount": COLUMNS} | about


def logarithms(light, flat=PHOTONS):
    return -np.log(light / flat).astype(np.float32)


def test_saturated_rays_pass_beside_the_object_but_at_the_border(caplog):
    light, chord = counts()
    values = logarithms(np.minimum(light, 0.8 * PHOTONS))
    with caplog.at_level(logging.WARNING):
        assert mend_light_end(values) == (np.count_nonzero(light >= 0.8 * PHOTONS), 0)
    assert "saturated" in caplog.text and "less light" in caplog.text
    zero = values == 0
    assert (chord[zero] == 0).mean() > 0.95 and zero.mean() > 0.3
    assert np.isnan(values).any()
    kept = np.isfinite(values) & ~zero
    np.testing.assert_array_equal(values[kept], logarithms(light)[kept])


@pytest.mark.parametrize(
    "kind",
    [
        "noise",
        "cut at the mean",
        "without noise",
        "without noise, air 0 to rounding",
        "without noise, air not 0",
        "8 bits without noise",
        "noise of matter alone",
        "one ray",
    ],
)
def test_a_scan_that_is_not_saturated_is_left_alone(kind, caplog):
    light, chord = counts()
    values = logarithms(light)
    if kind == "cut at the mean":
        values = np.maximum(values, 0)
    elif kind == "without noise":
        values = (0.1 * chord).astype(np.float32)
    elif kind == "without noise, air 0 to rounding":
        # Weights of a spectrum come to 1 but for their rounding.
        values = (0.1 * chord - np.log(np.full(100, 0.01, np.float32).sum() - 3e-7)).astype(np.float32)
        assert 0 < values.min() < 1e-6
    elif kind == "8 bits without noise":
        values = logarithms(np.floor(254.9 * np.exp(-0.1 * chord)), 254.9)
    elif kind == "noise of matter alone":
        values = (0.1 * chord * np.random.default_rng(1).normal(1, 0.02, chord.shape)).astype(np.float32)
    elif kind == "one ray":
        values[0, 0, 0] = -1.0
    before = values.copy()
    assert lower_end(values) is None and mend_light_end(values) == (0, 0)
    assert not caplog.records
    np.testing.assert_array_equal(values, before)


def uneven(dead=False):
    """Counts of a camera whose pixels differ, that saturates below the open field of most, (views, rows, columns)."""
    light, chord = counts()
    gains = 1 + 0.15 * np.cos(np.arange(COLUMNS) / 6) * np.ones((ROWS, 1))
    light = np.minimum(light * gains, 0.9 * PHOTONS)
    if dead:
        light[:, 3, 2] = 0
    return light.astype(np.float32), gains * PHOTONS, chord


@pytest.mark.parametrize("dead", [False, True])
def test_counts_that_reach_the_saturation_that_is_told_are_mended_alike(dead):
    light, flat, chord = uneven(dead)
    told = Counts.of(light, flat, saturation=0.9 * PHOTONS)
    values, found, _ = usable_rays(told, beam(np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)), None)
    bright = (light >= np.float32(0.9 * PHOTONS)) & (flat > 0.9 * PHOTONS)
    assert found["rays_saturated"] == bright.sum() > 0.3 * light.size
    zero = values == 0
    assert (chord[zero] == 0).mean() > 0.97 and zero.sum() > 0.6 * bright.sum()
    assert np.isnan(values[~zero & bright]).all() and np.isfinite(values[light < 0.9 * PHOTONS]).sum() > 0


def test_saturated_rays_tell_no_noise():
    light, _ = counts()
    values = logarithms(np.minimum(light, 0.8 * PHOTONS))
    mend_light_end(values)
    angles = np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)
    window = {f"Window{end}{axis}": sign * 20.0 for end, sign in (("Min", -1), ("Max", 1)) for axis in "XYZ"}
    volume = {"GridRowCount": 40, "GridColCount": 40, "GridSliceCount": 40, "option": window}
    problem = Problem.of(values, *from_astra(beam(angles), volume), "cm", None, None)
    assert problem.photons(torch.device("cpu")) == math.inf
    problem = replace(problem, given=(0.0,))
    assert 0.3 * PHOTONS < problem.photons(torch.device("cpu")) < 1.5 * PHOTONS
    problem.forget_told()
    assert problem.photons(torch.device("cpu")) < math.inf


def test_dead_pixels_of_no_light_in_the_open_field_are_not_saturated():
    light, chord = counts()
    values = logarithms(light)
    values[::2, 2:8, 2:9] = -np.inf
    assert mend_light_end(values) == (0, 0)
    assert np.isnan(values[::2, 2:8, 2:9]).all() and np.isfinite(values[1::2]).all()

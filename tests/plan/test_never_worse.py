"""A result explains the rays at least as well as its start, says how well, and keeps to its seconds."""

import logging
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch
from small_scans import QUICK, cone, fan, reconstruct

import tomo_polysplat as tps
from tomo_polysplat.fit.misses import misses
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.kernels import compile_time
from tomo_polysplat.plan.decision import When
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.one_energy import _after_short_fits
from tomo_polysplat.plan.order import decide, decide_start
from tomo_polysplat.plan.preparation import fit_start
from tomo_polysplat.report.decided import doubts
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.noise import RayNoise
from tomo_polysplat.scan.usable import usable_rays
from tomo_polysplat.settings import Settings

SPECTRA_ARE_DOUBTED = True  # see tests/conftest.py

CPU = torch.device("cpu")
# No short fits and no timed steps, which would take their share of a budget.
UNASKED = {
    "tv_factor": 1.0,
    "edges": "blurred",
    "growth": 1.0,
    "closer_seeds": 0.0,
    "max_gaussians": 60_000,
}


class HeldClock:
    """A clock that only what it is told of moves."""

    def __init__(self, monkeypatch, step=1.0, compiling=0.0):
        self.now, made, first = 1000.0, EagerStep.__call__, [compiling]

        def slow(one, *what):
            made(one, *what)
            seconds = first.pop() if first else 0.0
            self.now += step + seconds
            compile_time.add_compiled(seconds)

        monkeypatch.setattr(EagerStep, "__call__", slow)
        monkeypatch.setattr(compile_time, "_now", lambda: self.now)
        monkeypatch.setattr("tomo_polysplat.fit.scene.FitScene.seconds_of_basis", lambda *_: 0.0)


def rms(volume, scan):
    away = ~scan.metal_mask
    return float(np.sqrt(np.mean((volume - scan.truth)[away] ** 2)))


@cache
def start_with_metal():
    """The volume of a budget that is used up before the first step."""
    return reconstruct(cone(metal=True), time_budget=1e-6, settings={}).volume


@pytest.mark.parametrize("seconds", [3.0, 12.0, 60.0])
@pytest.mark.parametrize("compiling", [0.0, 500.0])
def test_a_budget_never_gives_less_than_the_start_and_does_not_count_compiling(
    monkeypatch, seconds, compiling
):
    scan = cone(metal=True)
    least = rms(start_with_metal(), scan)
    HeldClock(monkeypatch, compiling=compiling)
    result = reconstruct(scan, time_budget=seconds, settings=UNASKED)
    steps = result.history[-1]["iteration"]
    assert seconds - 1 <= steps <= seconds + 1
    assert rms(result.volume, scan) < 1.02 * least
    assert ("compiling" in result.plan) == bool(compiling)
    if compiling:
        assert result.plan["compiling"].value == pytest.approx(compiling, rel=0.01)


def test_what_a_budget_is_too_short_for_is_said_after_four_steps(monkeypatch, caplog):
    HeldClock(monkeypatch)
    told = []
    with caplog.at_level(logging.WARNING):
        result = reconstruct(
            fan(),
            time_budget=40.0,
            settings=UNASKED | {"passes": 10.0, "views_per_step": 4},
            callbacks=[lambda state: told.append((state.iteration, "room for about" in caplog.text))],
        )
    # 100 steps of a second each.
    assert result.plan["time_budget"].value == pytest.approx(0.4, abs=0.02)
    assert "about 60 s more" in result.plan["time_budget"].why and told[0] == (10, True)


def test_no_time_at_all_gives_the_start_itself(caplog):
    scan = fan(False)
    with caplog.at_level(logging.WARNING):
        result = reconstruct(scan, time_budget=1e-6)
    assert "start volume took all of the 1e-06 s of time_budget" in caplog.text
    assert result.plan["returned"].value == "start" and not result.gaussians
    assert result.counts["gaussians"] == 0 and result.volume.min() >= 0
    assert rms(result.volume, scan) < 0.1 * scan.truth.max()


def test_a_fit_that_ends_worse_than_its_start_is_not_returned(caplog):
    """Rates that no fit survives."""
    scan = cone(metal=True)
    wild = QUICK | {"learning_rate_attenuation": 3.0, "learning_rate_position": 9.0, "final_rate": 1.0}
    with caplog.at_level(logging.WARNING):
        result = reconstruct(scan, settings=wild)
    assert result.plan["returned"].value == "start" and "start volume is returned" in caplog.text
    assert np.array_equal(result.volume, start_with_metal())


def test_rays_that_are_not_explained_are_told(caplog):
    """An axis three pixels off; and the same scan as it was."""
    scan, settings = cone(24, metal=True), UNASKED | {"passes": 8.0, "views_per_step": 4}
    good = reconstruct(scan, settings=settings, align=False)
    with caplog.at_level(logging.WARNING):
        bad = reconstruct(scan, np.roll(scan.projections, 3, axis=2), settings=settings, align=False)
    assert "rays are not explained" in caplog.text and not good.plan["rays"].evidence["far"]
    assert bad.plan["rays"].value > 3 * good.plan["rays"].value
    assert f"missed by {bad.plan['rays'].value:.2g} times their noise" in bad.plan["rays"].why


def test_unexplained_rays_without_a_spectrum_ask_for_one(caplog, monkeypatch):
    monkeypatch.setattr("tomo_polysplat.plan.never_worse._FAR", 0.0)
    for spectrum, asked in ((None, "pass spectrum="), (fan().spectrum, "is the spectrum that of this scan")):
        caplog.clear()
        with caplog.at_level(logging.WARNING):
            reconstruct(fan(), spectrum=spectrum, settings={"passes": 0.5})
        assert asked in caplog.text
        # One energy has no pieces of metal.
        assert ("Metal thinner than a voxel" in caplog.text) == (spectrum is not None)


@pytest.mark.parametrize("held_out", [0.05, 0.0])
def test_the_truth_misses_its_rays_by_their_noise(held_out):
    scan = cone(metal=False)
    lab = lab_of_scan(scan, held_out)
    rays, noise, settings = lab.rays, RayNoise(4e3), lab.settings
    seeds = lab.seeds()
    with torch.no_grad():
        clean = lab.scene.projections(seeds, rays.views)[0]
    drawn = torch.from_numpy(np.random.default_rng(2).standard_normal(clean.shape, np.float32))
    noisy = replace(rays, projections=clean + drawn * noise.variance(clean).sqrt())
    found = misses(seeds, lab.scene, noisy, noise, settings)
    assert found.held_out == bool(held_out) and found.rays > 800
    assert found.times == pytest.approx(1.0, abs=0.06) and found.excess < 0.1 * found.misfit
    seeds.attenuation *= 1.1
    assert misses(seeds, lab.scene, noisy, noise, settings).excess > 0.2 * found.misfit
    silent = misses(seeds, lab.scene, noisy, RayNoise(), settings)
    assert math.isinf(silent.times) and silent.least == 0 and "allowed" in silent.describe()


def problem_of(scan):
    values, _, _ = usable_rays(scan.projections, scan.proj_geom, None, None, scan.spectrum)
    return Problem.of(values, *from_astra(scan.proj_geom, scan.vol_geom), scan.unit, scan.spectrum, None)


def lab_of_scan(scan, held_out):
    problem, settings = problem_of(scan), Settings(held_out=held_out, **UNASKED)
    lab = Lab(problem, first_volume(problem, CPU, settings)[0], settings, CPU, short_fit=fit_start)
    decide_start(lab)
    decide(lab, When.TRIAL)
    return lab


def test_a_spectrum_that_fits_worse_than_one_energy_is_named(caplog):
    """A bare tube of 40 kV told for one of 90 kV with its filters."""
    scan = cone(metal=True)
    with caplog.at_level(logging.WARNING):
        good = reconstruct(scan)
        assert "spectrum does not fit" not in caplog.text and "spectrum_doubt" not in good.plan
        bad = reconstruct(scan, spectrum=tps.Spectrum.from_tube(40, filters={}))
    assert "spectrum does not fit" in caplog.text and "voltage" in bad.plan["spectrum_doubt"].why
    assert any("the spectrum" in words for words in doubts(bad.plan))


def test_joined_pixels_show_a_wrong_spectrum_as_well():
    """Of 73 columns 36 are left: a bare tube of 60 kV told for one of 90 kV with its filter."""
    scan = tps.simulate_scan("pancreas", size=37, views=49, columns=73, geometry="parallel", metal=False)
    options = FitOptions(Settings(**UNASKED), None, 0, CPU)
    by_energy, by_own = _after_short_fits(problem_of(scan), options)
    again, by_wrong = _after_short_fits(
        problem_of(replace(scan, spectrum=tps.Spectrum.from_tube(60))), options
    )
    assert by_energy == pytest.approx(again) and again < 0.9 * by_wrong and by_energy > 0.9 * by_own

"""Views of a parallel beam add up to one mass once nothing hardens, and only then."""

import logging

import astra
import numpy as np
import pytest

import tomo_polysplat as tps
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.water import water_linearised
from tomo_polysplat.physics.water_correction import undo_water_correction, usual_water_correction
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.mass_of_views import hardening_shown

SPECTRUM = tps.Spectrum.from_tube(90, filters="Al 1mm", detector="csi:0.6mm")
ANGLES = np.arange(90) * np.pi / 90
PARALLEL = astra.create_proj_geom("parallel", 0.1, 80, ANGLES)
VOLUME = astra.create_vol_geom(40, 40, -3.5, 3.5, -3.5, 3.5)


def ellipse(shift=0.0, photons=3e5, size=(3.2, 1.6)):
    """Rays (views, 1, columns) through water in an ellipse of some half axes in cm, in closed form."""
    across = (np.arange(80) - 39.5) * 0.1 - shift
    square = (size[0] * np.cos(ANGLES)) ** 2 + (size[1] * np.sin(ANGLES)) ** 2
    chord = 2 * size[0] * size[1] * np.sqrt(np.clip(square[:, None] - across**2, 0, None)) / square[:, None]
    curve = mass_attenuation("water", SPECTRUM.energies)[None]
    values = projection(chord[None], np.log(np.maximum(SPECTRUM.weights, 1e-30)), curve)
    counts = np.random.default_rng(1).poisson(photons * np.exp(-values))
    return -np.log(counts / photons)[:, None]


def shown(values, geometry=PARALLEL):
    return hardening_shown(values, from_astra(geometry, VOLUME)[0], SPECTRUM)


@pytest.mark.parametrize("shift", [0.0, 0.23])
def test_water_shows_all_of_the_hardening_and_corrected_rays_none(shift):
    raw = ellipse(shift)
    found, corrected = shown(raw), shown(water_linearised(raw, SPECTRUM))
    assert found.share == pytest.approx(1.0, abs=3 * found.error) and found.error < 0.1 and not found.none
    assert corrected.share == pytest.approx(0.0, abs=3 * corrected.error) and corrected.none


def test_a_dead_column_is_bridged():
    raw = ellipse()
    raw[:, :, 30] = np.nan
    assert shown(raw).share == pytest.approx(1.0, abs=0.2)


def test_what_cannot_tell_says_nothing():
    round_one = shown(ellipse(size=(2.0, 2.0)))
    assert round_one is None or not round_one.none
    raw = ellipse()
    assert shown(raw[:, :, 20:60], astra.create_proj_geom("parallel", 0.1, 40, ANGLES)) is None
    assert shown(raw, astra.create_proj_geom("parallel", 0.1, 80, ANGLES / 4)) is None
    assert shown(raw, astra.create_proj_geom("fanflat", 0.1, 80, ANGLES, 50.0, 10.0)) is None


@pytest.mark.parametrize(("kvp", "largest"), [(60, 3.0), (90, 8.0), (140, 12.0)])
def test_the_usual_correction_is_that_of_water(kvp, largest):
    spectrum = tps.Spectrum.from_tube(kvp, filters="Al 2mm", detector="csi:0.6mm")
    measured = np.linspace(0.0, largest, 300)
    corrected = water_linearised(measured, spectrum)
    usual = usual_water_correction(spectrum, corrected.max())
    assert np.abs(np.polynomial.Polynomial(usual)(measured) - corrected).max() < 0.01
    assert np.abs(undo_water_correction(corrected, usual) - measured).max() < 0.015
    with pytest.raises(ValueError, match="largest"):
        usual_water_correction(spectrum, 0.0)


def test_a_run_names_rays_that_were_corrected(caplog):
    raw = ellipse()
    options = {
        "spectrum": SPECTRUM,
        "unit": "cm",
        "settings": {"passes": 1.0, "views_per_step": 8, "held_out": 0.0},
    }
    with caplog.at_level(logging.WARNING):
        good = tps.reconstruct(raw[:, 0].astype(np.float32), PARALLEL, VOLUME, **options)
        assert "spectrum_doubt" not in good.plan
        corrected = water_linearised(raw[:, 0], SPECTRUM).astype(np.float32)
        bad = tps.reconstruct(corrected, PARALLEL, VOLUME, **options)
    assert bad.plan["spectrum_doubt"].evidence["share"] == pytest.approx(0.0, abs=0.2)
    assert "water_correction=(0, " in caplog.text

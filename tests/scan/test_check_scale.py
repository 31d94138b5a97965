"""The base of the logarithm by the law of the noise, the unit of length by what matter there is, and doubled ends."""

from dataclasses import replace

import numpy as np
import pytest
from one_probe import answer

import tomo_polysplat as tps
from tomo_polysplat.scan.check import DEFECT, OK, UNKNOWN
from tomo_polysplat.scan.geometry import from_astra, to_astra
from tomo_polysplat.scan.scan import Scan

PHOTONS, RADIUS = 400.0, 0.8


def water(photons=PHOTONS, seed=0, doubled=False, told=None):
    """A cylinder of water in 91 columns of a parallel beam, with Poisson counts, and three rods in it."""
    columns, views, pixel = 91, 61, 0.021
    angles = np.linspace(0, 2 * np.pi, views, endpoint=doubled)
    across = (np.arange(columns) - 45) * pixel
    path = 2 * np.sqrt(np.clip(RADIUS**2 - across**2, 0, None))[None]
    for x, y in ((0.4, 0.1), (-0.3, 0.3), (0.0, -0.5)):
        away = across - x * np.cos(angles)[:, None] - y * np.sin(angles)[:, None]
        path = path + 2 * np.sqrt(np.clip(0.15**2 - away**2, 0, None))
    light = np.random.default_rng(seed).poisson(photons * np.exp(-0.9 * np.repeat(path[None], 9, axis=0)))
    values = -np.log(np.maximum(light, 1) / photons)
    angles = np.linspace(0, 2 * np.pi, views, endpoint=doubled if told is None else told)
    proj_geom, vol_geom = tps.parallel_geometry(pixel=pixel, detector=(9, columns), radians=angles)
    spectrum = tps.Spectrum.monochromatic(14.5)  # where water attenuates by about 1.7 1/cm
    return Scan(values.astype(np.float32), proj_geom, vol_geom, spectrum=spectrum)


@pytest.mark.parametrize("photons", [100.0, 400.0])
def test_the_noise_tells_the_base_of_the_logarithm(photons):
    scan = water(photons)
    natural = answer(scan, "base of the logarithm")
    assert natural.verdict == OK and natural.values["slope"] == pytest.approx(1.0, abs=0.3)
    decadic = answer(replace(scan, projections=scan.projections / np.log(10)), "base of the logarithm")
    # Fine detail can pass for such noise: what it may be is said, and no more.
    assert decadic.verdict == UNKNOWN and "2.3026" in decadic.remedy
    # The slope goes with the factor exactly, for it is that of the same numbers.
    assert decadic.values["slope"] == pytest.approx(np.log(10) * natural.values["slope"], rel=0.2)


def test_without_noise_the_base_is_unknown():
    scan = water(1e12)
    assert answer(scan, "base of the logarithm").verdict == UNKNOWN


@pytest.mark.parametrize(
    ("times", "verdict", "density"),
    [(1.0, OK, 0.55), (10.0, UNKNOWN, 0.055), (0.1, OK, 5.5), (1e4, DEFECT, 5.5e-5), (1e-4, DEFECT, 5.5e3)],
)
def test_lengths_make_matter_of_a_possible_density(times, verdict, density):
    scan = water()
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    proj_geom, vol_geom = to_astra(geometry.scaled(times), grid.scaled(times))
    spectrum = tps.Spectrum([14.0, 15.0], [0.5, 0.5])
    found = answer(replace(scan, proj_geom=proj_geom, vol_geom=vol_geom, spectrum=spectrum), "unit of length")
    assert found.values["density"] == pytest.approx(density, rel=0.25)
    assert found.verdict == verdict
    assert answer(replace(scan, spectrum=None), "unit of length").verdict == UNKNOWN


@pytest.mark.parametrize(
    ("went", "told", "verdict", "remedy"),
    [
        (False, False, OK, ""),
        (True, True, OK, ""),
        (True, False, DEFECT, "endpoint=True"),
        (False, True, UNKNOWN, "endpoint=False"),
    ],
)
def test_the_last_view_tells_whether_a_turn_has_a_step_less(went, told, verdict, remedy):
    found = answer(water(1e5, doubled=went, told=told), "last view")
    assert found.verdict == verdict and remedy in found.remedy


def test_noise_hides_where_the_last_view_is():
    for went in (False, True):
        assert answer(water(30.0, doubled=went, told=False), "last view").verdict == UNKNOWN

"""Light matter hardens the beam less than a solid of the density that too short lengths give it."""

import logging

import astra
import numpy as np
import pytest
import torch
from small_scans import QUICK

import tomo_polysplat as tps
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.materials import density, mass_attenuation
from tomo_polysplat.plan.hardening import coarse, hardening_of

SPECTRUM = tps.Spectrum.from_tube(90, filters="Al 1mm", detector="csi:0.6mm")


def disc(material, radius):
    """A disc with a hole beside its middle, 48 views of a parallel beam in closed form, in cm."""
    width = 2.4 * radius / 61
    proj_geom = astra.create_proj_geom("parallel", width, 61, angles := np.arange(48) * np.pi / 48)
    vol_geom = astra.create_vol_geom(49, 49, *[-1.1 * radius, 1.1 * radius] * 2)
    across = (np.arange(61) - 30) * width
    hole = 0.3 * radius * np.cos(angles[:, None])
    chords = [
        2 * np.sqrt(np.clip((share * radius) ** 2 - at**2, 0, None))
        for share, at in ((1, across[None]), (0.2, across - hole))
    ]
    areal = density(material) * (chords[0] - chords[1])
    curve = mass_attenuation(material, SPECTRUM.energies)
    weights = np.log(np.maximum(SPECTRUM.weights, 1e-30))
    values = projection(areal.reshape(1, -1), weights, curve[None])
    return values.reshape(48, 61).astype(np.float32), proj_geom, vol_geom


@pytest.mark.parametrize(
    ("material", "radius", "unit", "meant"),
    [
        ("pmma", 1.0, "cm", None),
        ("pmma", 1.0, "mm", "cm"),
        ("water", 0.4, "mm", "cm"),
        ("aluminium", 0.5, "cm", None),
        ("titanium", 0.1, "cm", None),
        ("SiO2", 0.4, "cm", None),
    ],
)
def test_lengths_ten_times_too_short_are_doubted(material, radius, unit, meant, caplog):
    """The lengths are those in cm."""
    with caplog.at_level(logging.WARNING):
        result = tps.reconstruct(
            *disc(material, radius), unit=unit, spectrum=SPECTRUM, settings=QUICK, align=False
        )
    assert ("lengths" in result.plan) == (meant is not None)
    if meant:
        assert (
            f"pass unit='{meant}'" in caplog.text and "hardens the beam as light matter does" in caplog.text
        )


def piece(slope, shape=(1, 40, 40)):
    """A disc that is `slope` brighter in its middle than at its rim, of level 1 on average."""
    y, x = np.mgrid[: shape[1], : shape[2]] - 19.5
    radius = np.hypot(x, y)
    level = np.where(radius < 17, 1 + slope * (0.5 - (radius / 17) ** 2), 0.0)
    return np.broadcast_to(level, shape).astype(np.float32)


@pytest.mark.parametrize(("light", "dense", "share"), [(-0.1, 0.0, 1.0), (0.0, 0.1, 0.0), (-0.05, 0.05, 0.5)])
def test_the_share_is_what_bends_the_level(light, dense, share):
    assert hardening_of(piece(light), piece(dense)) == pytest.approx(share, abs=0.02)


def test_what_does_not_bend_tells_nothing():
    assert hardening_of(piece(0.001), piece(0.004)) is None
    assert hardening_of(0 * piece(0.0), 0 * piece(0.0)) is None
    assert hardening_of(piece(0.0)[:, ::8, ::8], piece(0.1)[:, ::8, ::8]) is None


def test_large_volumes_are_looked_at_coarsely():
    volume = torch.ones(40, 200, 300)
    assert coarse(volume).shape == (5, 50, 75)
    np.testing.assert_allclose(coarse(volume), 1.0)
    assert coarse(torch.ones(1, 5, 7)).shape == (1, 5, 7)

"""The level of an object's main matter."""

import numpy as np
import pytest

from tomo_polysplat.start.levels import main_level, mass_level


@pytest.mark.parametrize("values", [[1.0, 1, 1, 1, 1], [1.0, 2, 3], [5.0, 1, 1, 1], [0.0, 0, 2, -3]])
def test_mass_level_halves_the_mass(values):
    volume = np.array(values, np.float32)
    level = mass_level(volume)
    positive = volume[volume > 0]
    assert positive[positive <= level].sum() >= 0.5 * positive.sum()
    assert positive[positive < level].sum() < 0.5 * positive.sum()


def test_mass_level_of_nothing_is_zero():
    assert mass_level(np.zeros((3, 3, 3))) == mass_level(-np.ones((3, 3, 3))) == 0


def test_mass_level_is_not_moved_by_noise_and_little_metal():
    rng = np.random.default_rng(0)
    volume = np.where(rng.random(20000) < 0.4, 1.0, 0.0) + 0.05 * rng.standard_normal(20000)
    volume[:10] = 100.0
    assert mass_level(volume) == pytest.approx(1.0, abs=0.05)


def test_metal_does_not_raise_the_main_level():
    # More than half the mass is metal: a level of half of all mass lies in it.
    volume = np.concatenate([np.full(1000, 0.2), np.full(20, 12.0)])
    assert mass_level(volume) == 12.0
    assert main_level(volume) == pytest.approx(0.2)
    assert main_level(volume[:1000]) == pytest.approx(0.2)
    assert main_level(np.concatenate([volume[:1000], np.full(10, 12.0)])) == pytest.approx(0.2)


@pytest.mark.parametrize("metal", [3.0, 6.0, 12.0, 40.0])
def test_the_main_level_is_that_of_soft_matter_however_much_mass_a_rod_holds(metal):
    y, x = np.mgrid[-1:1:47j, -1:1:47j]
    volume = np.where(np.hypot(x, y) < 0.7, 0.2, 0.0) + 0.01 * np.random.default_rng(0).normal(size=x.shape)
    volume[np.hypot(x - 0.3, y) < 0.17] = metal
    assert main_level(volume[None]) == pytest.approx(0.2, rel=0.05)


@pytest.mark.parametrize("radius", [0.12, 0.2, 0.6])
def test_a_solid_in_noise_or_in_little_that_is_light_is_the_main_matter(radius):
    z, y, x = np.mgrid[-1:1:23j, -1:1:25j, -1:1:27j]
    distance = np.sqrt(x**2 + y**2 + z**2)
    volume = np.where(distance < radius, 1.0, 0.0) + 0.0005 * np.random.default_rng(0).normal(size=x.shape)
    wrapped = np.where((distance > radius) & (distance < 1.3 * radius), 0.1, volume)
    assert main_level(volume) == pytest.approx(1.0, rel=0.05)
    assert main_level(wrapped) == pytest.approx(1.0, rel=0.05)

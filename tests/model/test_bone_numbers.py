"""Material numbers that matter denser than soft matter starts from."""

import pytest
import torch

from tomo_polysplat.model.bone_numbers import start_numbers
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.stand_in import best_stand_in
from tomo_polysplat.settings import Settings

SPECTRUM = Spectrum.from_tube(90, filters={"Al": 0.1})
MINERAL, DENSITY = "Ca5P3O13H", 3.16  # hydroxyapatite, g/cm3


@pytest.mark.parametrize("share", [0.07, 0.2, 0.35, 0.6, 0.9])
def test_mixtures_of_water_and_bone_mineral_start_with_the_number_that_stands_for_them(share):
    density = share * DENSITY + (1 - share)
    mixture = {MINERAL: share * DENSITY / density, "water": (1 - share) / density}
    energy = [SPECTRUM.effective_energy]
    relative = density * mass_attenuation(mixture, energy) / mass_attenuation("water", energy)
    expected = best_stand_in(mixture, SPECTRUM).u
    assert float(start_numbers(torch.from_numpy(relative), Settings())) == pytest.approx(expected, abs=0.04)


def test_soft_matter_keeps_its_number_whatever_noise_does_to_it():
    settings = Settings(soft_u=-0.02)
    below = torch.tensor([-2.0, -1.0, 0.0, 1.0, 1.29])
    assert start_numbers(below, settings).tolist() == pytest.approx([-0.02] * 5)


def test_the_number_of_bone_is_reached_at_its_attenuation_and_grows_on():
    numbers = start_numbers(torch.tensor([2.0, 4.0, 8.0, 1e6]), Settings(bone_u=0.36))
    assert float(numbers[1]) == pytest.approx(0.36)
    assert (numbers.diff() > 0).all() and float(numbers[-1]) == pytest.approx(0.6, abs=1e-5)

"""Fat beside water, which hardens the beam less: told, it comes out as it is."""

import numpy as np
import pytest
from small_scans import disc

import tomo_polysplat as tps
from tomo_polysplat.physics.materials import density, mass_attenuation
from tomo_polysplat.settings import Settings

SPECTRUM = tps.Spectrum.from_tube(90, filters={"Al": 0.1})


def core_error(core, seed=0, **settings):
    """Relative error of the mean inside a disc of some matter in one of water, 6 cm wide."""
    projections, proj_geom, vol_geom = disc(core, SPECTRUM, half=3.0)
    # Where the scanner stood is asked in other files.
    settings = {"passes": 10.0, "views_per_step": 5} | settings
    options = {"spectrum": SPECTRUM, "unit": "cm", "align": False, "settings": settings, "seed": seed}
    result = tps.reconstruct(projections, proj_geom, vol_geom, **options)
    y, x = np.mgrid[:45, :45] - 22
    true = density(core) * mass_attenuation(core, [result.energy_kev])[0]
    return float(result.volume[np.hypot(x, y) < 4].mean()) / true - 1


# What the rays decide on the way.
HELD = {"tv_factor": 1.0, "soft_gain": 0.0}


def mean_error(core, **settings):
    """Over three seeds, of which one moves a mean by up to 0.003."""
    return np.mean([core_error(core, seed, **HELD, **settings) for seed in range(3)])


# The number of polyethylene lies beyond the last that settings take.
@pytest.mark.parametrize(("matter", "number"), [("adipose", -0.056), ("polyethylene", -0.1)])
def test_fat_is_too_light_by_waters_number_and_right_by_its_own(matter, number):
    # Without a number of its own one seed tells it: three agree to 0.001.
    assert core_error(matter, views_per_step=8, **HELD) < -0.009
    assert abs(mean_error(matter, light="fat", light_u=number, views_per_step=8)) < 0.007


def test_what_is_no_lighter_than_water_keeps_its_number():
    told, untold = (mean_error("muscle", **choice) for choice in ({"light": "fat"}, {"curves": 3}))
    assert told == pytest.approx(untold, abs=2e-3)


@pytest.mark.parametrize("value", [0.3, -0.2])
def test_the_number_is_one_that_curves_reach(value):
    with pytest.raises(ValueError, match=r"light_u.*>= -0.1 and <= 0.1"):
        Settings(light="fat", light_u=value)


def test_one_curve_has_no_other_number():
    with pytest.raises(ValueError, match="light"):
        Settings(curves=1, light="fat")

"""Fat beside water, which hardens the beam less: told, it comes out as it is."""

import numpy as np
import pytest
from small_scans import disc

import tomo_polysplat as tps
from tomo_polysplat.physics.materials import density, mass_attenuation
from tomo_polysplat.settings import Settings

SPECTRUM = tps.Spectrum.from_tube(90, filters={"Al": 0.1})


# What the rays decide on the way.
HELD = {"tv_factor": 1.0, "soft_gain": 0.0, "gains": False, "drift": False}


def of_disc(core, seed=0, **settings):
    """The fit of a disc of some matter in one of water, 6 cm wide."""
    projections, proj_geom, vol_geom = disc(core, SPECTRUM, half=3.0)
    # Where the scanner stood is asked in other files.
    settings = {"passes": 10.0, "views_per_step": 8} | HELD | settings
    options = {"spectrum": SPECTRUM, "unit": "cm", "align": False, "settings": settings, "seed": seed}
    options["calibrate"] = False
    return tps.reconstruct(projections, proj_geom, vol_geom, **options)


def core_error(result, core):
    """Relative error of the mean inside, a voxel or two from the edge."""
    y, x = np.mgrid[:45, :45] - 22
    true = density(core) * mass_attenuation(core, [result.energy_kev])[0]
    return float(result.volume[np.hypot(x, y) < 4].mean()) / true - 1


def numbers_inside(result):
    """Material numbers of the Gaussians there."""
    return result.gaussians["u"][np.hypot(*result.gaussians["position"][:, :2].T) < 4 / 45 * 6]


# The number of polyethylene lies beyond the last that settings take.
@pytest.mark.parametrize(("matter", "number"), [("adipose", -0.056), ("polyethylene", -0.1)])
def test_fat_is_too_light_by_waters_number_and_right_by_its_own(matter, number):
    # Without a number of its own one seed tells it: three agree to 0.001.
    assert core_error(of_disc(matter), matter) < -0.009
    told = [of_disc(matter, seed, light="fat", light_u=number) for seed in range(2)]
    assert abs(np.mean([core_error(result, matter) for result in told])) < 0.007
    assert all(len(numbers_inside(result)) > 20 for result in told)
    assert all((numbers_inside(result) < 0.9 * number).all() for result in told)


def test_what_is_no_lighter_than_water_keeps_its_number():
    numbers = numbers_inside(of_disc("muscle", light="fat"))
    assert len(numbers) > 20 and (np.abs(numbers) < 0.1 * 0.056).all()


@pytest.mark.parametrize("value", [0.3, -0.2])
def test_the_number_is_one_that_curves_reach(value):
    with pytest.raises(ValueError, match=r"light_u.*>= -0.1 and <= 0.1"):
        Settings(light="fat", light_u=value)


def test_one_curve_has_no_other_number():
    with pytest.raises(ValueError, match="light"):
        Settings(curves=1, light="fat")

"""What the plan leaves out of a model changes nothing that the scan shows."""

import numpy as np
import pytest
from small_scans import QUICK, cone, fan, reconstruct, relative

from tomo_polysplat.physics.spectrum import Spectrum


@pytest.fixture(scope="module")
def control():
    return reconstruct(cone())


def test_a_scan_without_dense_matter_is_modelled_by_one_curve(control):
    """It is the same model: the weights of the other two curves are zero."""
    assert control.plan["curves"].value == 1
    # Two energies are as many nodes, the same for one curve and for three. They are not the scan's, so that the
    # number of the one matter there is would move, were it not held.
    pair = {"spectrum": Spectrum(np.array([35.0, 70.0]), np.array([0.5, 0.5]))}
    one, three = (
        reconstruct(cone(), **pair, settings=QUICK | {"curves": n, "soft_gain": 0}) for n in (None, 3)
    )
    assert one.plan["curves"] != three.plan["curves"] and "2 spectral nodes" in three.plan["spectrum"].why
    assert relative(one.volume, three.volume) < 1e-3


def test_one_curve_answers_what_three_do(control):
    water = control.materials.mass_attenuation([40.0, control.energy_kev])[0]
    assert not control.material.any() and not control.gaussians["u"].any()
    np.testing.assert_allclose(control.attenuation(40.0), control.density * water[0], rtol=1e-5)
    np.testing.assert_allclose(control.volume, control.density * water[1], rtol=1e-5)


def test_metal_keeps_three_curves():
    result = reconstruct(fan(metal=True))
    assert result.plan["curves"].value == 3 and result.material.max() > 0.5


def test_a_spectrum_of_one_energy_is_a_monochromatic_fit():
    """Where the rays were measured at one energy, its name alone must not change the volume."""
    scan = cone()
    named, none = (reconstruct(scan, spectrum=s) for s in (Spectrum.monochromatic(55.0), None))
    assert np.array_equal(named.volume, none.volume) and named.energy_kev == 55.0


def test_a_narrow_spectrum_is_one_energy():
    """Two energies a hundredth of a kev apart have no hardening to show, and the fit becomes a linear one."""
    scan, narrow = cone(), Spectrum(np.array([55.0, 55.01]), np.array([0.5, 0.5]))
    result, none = reconstruct(scan, spectrum=narrow), reconstruct(scan, spectrum=None)
    assert "one energy" in result.plan["hardening"].why and "1 spectral node:" in result.plan["spectrum"].why
    # Seeds differ a little, for what is empty is told by water in one and by the object in the other.
    difference = np.square(result.volume - none.volume).mean() / np.square(none.volume).mean()
    assert difference**0.5 < 0.05
    assert result.volume.sum() == pytest.approx(none.volume.sum(), rel=5e-3)

"""An object of one material comes out even, of a light metal as well as of water."""

import numpy as np
import pytest

import tomo_polysplat as tps
from tomo_polysplat.physics.materials import density, mass_attenuation
from tomo_polysplat.scan.circular import parallel_geometry

COLUMNS, VIEWS, PIXEL, RADIUS, PHOTONS = 45, 90, 0.05, 0.9, 2e4


def disc_scan(material):
    """Noisy projections of a disc (radius in cm), its geometries, spectrum and true attenuation."""
    spectrum = tps.Spectrum.from_tube(120, filters={"Cu": 0.05})
    theta = np.linspace(0, np.pi, VIEWS, endpoint=False)
    proj_geom, vol_geom = parallel_geometry(pixel=PIXEL, radians=theta, detector=(1, COLUMNS))
    across = PIXEL * (np.arange(COLUMNS) + 0.5 - COLUMNS / 2)
    areal = density(material) * 2 * np.sqrt(np.maximum(RADIUS**2 - across**2, 0))
    light = np.exp(-np.outer(areal, mass_attenuation(material, spectrum.energies))) @ spectrum.weights
    counts = np.random.default_rng(0).poisson(PHOTONS * light, (1, VIEWS, COLUMNS))
    true = density(material) * float(mass_attenuation(material, spectrum.effective_energy))
    return -np.log(counts / PHOTONS), proj_geom, vol_geom, spectrum, true


@pytest.mark.parametrize("material", ["water", "aluminium"])
def test_a_disc_of_one_material_is_even(material):
    projections, proj_geom, vol_geom, spectrum, true = disc_scan(material)
    options = {"spectrum": spectrum, "quality": "fast", "settings": {"views_per_step": 10}}
    result = tps.reconstruct(projections, proj_geom, vol_geom, progress=False, align=False, **options)
    axis = PIXEL * (np.arange(COLUMNS) + 0.5 - COLUMNS / 2)
    inside = np.hypot(*np.meshgrid(axis, axis)) < RADIUS - 3 * PIXEL
    values = result.volume.reshape(COLUMNS, COLUMNS)[inside]
    assert values.std() < 0.03 * true
    assert values.mean() == pytest.approx(true, rel=0.02)

"""Pixels whose flat field has no light hold noise; few photons, and gamma rays behind metal, do not."""

import numpy as np
import pytest

from tomo_polysplat.scan.counts import Counts
from tomo_polysplat.scan.erratic import erratic_pixels
from tomo_polysplat.scan.usable import usable_rays

VIEWS, ROWS, COLUMNS = 41, 9, 23


def line_integrals(photons, seed=0):
    rng = np.random.default_rng(seed)
    depth = np.where(np.abs(np.arange(COLUMNS) - 11) < 7, 1.7, 0.0) * np.ones((VIEWS, ROWS, 1))
    counts = rng.poisson(photons * np.exp(-depth)) / photons
    with np.errstate(divide="ignore"):
        return -np.log(counts)


def test_noise_over_no_light_is_found_and_its_neighbours_are_not():
    values = line_integrals(1e4)
    bad = np.zeros((ROWS, COLUMNS), bool)
    bad[3:5, 8:10] = bad[7, 0] = True
    light = np.random.default_rng(1).normal(size=(VIEWS, bad.sum())) / 0.1
    values[:, bad] = np.where(light > 0, -np.log(np.maximum(light, 1e-9)), np.inf)
    np.testing.assert_array_equal(erratic_pixels(values), bad)


@pytest.mark.parametrize("photons", [1, 2, 5, 30])
def test_few_photons_are_no_fault(photons):
    assert not erratic_pixels(line_integrals(photons)).any()


def test_a_gamma_ray_behind_opaque_metal_is_no_fault():
    values = line_integrals(1e4)
    values[:, 2:6, 9:14] = np.inf
    values[17, 4, 10] = -1.5
    assert not erratic_pixels(values).any()


def test_a_run_leaves_them_out(caplog):
    from ellipsoids import cone_scan, orbit, whole_turn

    rng, vectors = np.random.default_rng(2), orbit(whole_turn(VIEWS))
    counts = rng.poisson(2e4 * np.exp(-line_integrals(1e5).swapaxes(0, 1).clip(0, 4))) + 400.0
    flat, dark = np.full((ROWS, COLUMNS), 2.04e4), np.full((ROWS, COLUMNS), 400.0)
    counts[4, :, 6] = 5000 + 300 * rng.normal(size=VIEWS)
    flat[4, 6], dark[4, 6] = 5003.0, 5000.0
    scan = cone_scan(counts, vectors)
    told = Counts.of(np.rint(counts).astype(np.uint16).swapaxes(0, 1), flat[None], dark[None])
    values, found, _ = usable_rays(told, scan.proj_geom, None)
    assert not np.isfinite(values[:, 4, 6]).any() and np.isfinite(np.delete(values[:, 4], 6, 1)).all()
    assert found["rays_of_stuck_pixels"] > 10 and "left out: 1" in caplog.text

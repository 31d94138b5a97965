"""The exposure read off the data of Poisson scans whose exposure is known."""

import numpy as np
import pytest
import torch
from scipy import ndimage
from small_scans import fan, reconstruct

from tomo_polysplat.scan.noise import RayNoise, correlation_of_noise, photons_per_ray, ray_noise
from tomo_polysplat.scan.usable import usable_rays

PARALLEL = {"type": "parallel3d", "DetectorSpacingX": 1.0, "DetectorSpacingY": 1.0}
PARALLEL |= {
    "DetectorRowCount": 9,
    "DetectorColCount": 97,
    "ProjectionAngles": np.linspace(0, np.pi, 40, False),
}


def disc(peak, views=40, rows=9, columns=97):
    """Projections of an ellipsoid with a smooth profile in air; none of it needs resolving."""
    u = np.linspace(-1.4, 1.4, columns)
    v = np.linspace(-0.6, 0.6, rows)[:, None]
    turn = np.linspace(0, np.pi, views, endpoint=False)[:, None, None]
    across = (u / (1 + 0.2 * np.cos(2 * turn))) ** 2 + v**2
    return peak * np.sqrt(np.clip(1 - across, 0, None))


def poisson(projections, photons, seed=0):
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-projections))
    return -np.log(np.maximum(counts, 0.5) / photons).astype(np.float32)


@pytest.mark.parametrize("peak", [0.3, 1.5, 3.0])
@pytest.mark.parametrize("photons", [300.0, 5e3, 1e5])
def test_the_exposure_of_a_poisson_scan_is_found(photons, peak):
    found = photons_per_ray(poisson(disc(peak), photons))
    assert found == pytest.approx(photons, rel=0.15)


@pytest.mark.parametrize("peak", [0.3, 1.5, 3.0, 8.0])
def test_normal_noise_of_any_depth_is_not_taken_for_that_of_counts(peak):
    scan, deviation = disc(peak), 0.02 * peak
    noisy = scan + np.random.default_rng(4).normal(0, deviation, scan.shape).astype(np.float32)
    found = ray_noise(noisy)
    if peak > 1:
        assert found.photons == np.inf and found.deviation == pytest.approx(deviation, rel=0.15)
    depth = np.array([0.2 * peak, 0.6 * peak])
    np.testing.assert_allclose(found.variance(depth), deviation**2, rtol=0.3)


def test_a_single_view_tells_its_noise():
    assert photons_per_ray(poisson(disc(1.5, views=1, rows=61), 1e4)) == pytest.approx(1e4, rel=0.3)


def test_unusable_rays_do_not_matter():
    scan = poisson(disc(1.0), 1e4)
    scan[np.random.default_rng(1).random(scan.shape) < 0.1] = np.nan
    assert photons_per_ray(scan) == pytest.approx(1e4, rel=0.15)


def test_gains_of_pixels_are_no_noise():
    for photons in (1e3, 1e5):
        scan = poisson(disc(1.0), photons)
        gained = scan + np.random.default_rng(2).normal(0, 0.03, (1, *scan.shape[1:]))
        assert photons_per_ray(gained) == pytest.approx(photons_per_ray(scan), rel=0.15)


def test_values_that_rays_were_given_tell_no_noise():
    """A third of the rays are opaque: what they were given has no scatter at all."""
    with np.errstate(divide="ignore"):
        counts = np.random.default_rng(0).poisson(2e3 * np.exp(-disc(14.0)))
        values, found, given = usable_rays(-np.log(counts / 2e3).swapaxes(0, 1), PARALLEL, None)
    assert found["rays_opaque"] > 0.25 * values.size and (values == given[0]).sum() == found["rays_opaque"]
    assert photons_per_ray(values, given=given) == pytest.approx(2e3, rel=0.15) != photons_per_ray(values)


@pytest.mark.parametrize("limit", [0.004, 0.5])
def test_an_end_of_the_scale_tells_no_noise(limit):
    """Whether rays there are taken for opaque or left as they are."""
    values = np.minimum(poisson(disc(9.0), 1e5), np.float32(-np.log(limit)))
    told, found, given = usable_rays(values.swapaxes(0, 1), PARALLEL, None)
    assert (found["rays_opaque"] == 0) == (limit == 0.5) and set(given) & set(np.unique(told))
    assert photons_per_ray(told, given=given) == pytest.approx(1e5, rel=0.2)


def test_an_order_of_magnitude_in_exposure_is_an_order_of_magnitude_found():
    low, high = (photons_per_ray(poisson(disc(1.0), n)) for n in (1e3, 1e4))
    assert high / low == pytest.approx(10, rel=0.2)


@pytest.mark.parametrize(
    "projections",
    [
        np.zeros((30, 4, 64), np.float32),
        np.full((30, 4, 64), 1.5, np.float32),
        np.full((30, 4, 64), 740.0, np.float32),
        np.broadcast_to(np.arange(64, dtype=np.float32) / 64, (30, 4, 64)),
        np.where(np.arange(64) % 32 < 16, 0.0, 1.0).astype(np.float32) * np.ones((30, 4, 1), np.float32),
    ],
    ids=["air", "flat", "opaque", "ramp", "blocks"],
)
def test_noiseless_data_have_infinitely_many_photons(projections):
    assert photons_per_ray(projections) == np.inf


@pytest.mark.parametrize("shape", [(1, 1, 1), (3, 1, 4), (1, 1, 8), (2, 1, 30)])
def test_too_few_rays_say_nothing(shape):
    assert photons_per_ray(np.random.default_rng(0).random(shape).astype(np.float32)) == np.inf


def test_nothing_usable_says_nothing():
    assert photons_per_ray(np.full((20, 4, 64), np.nan, np.float32)) == np.inf


def test_of_many_rays_every_so_many_rows_tell_as_well(monkeypatch):
    scan = poisson(disc(1.0, rows=41), 1e4)
    whole, some = photons_per_ray(scan), photons_per_ray(scan[:, ::8])
    monkeypatch.setattr("tomo_polysplat.scan.noise._MOST", scan.size)
    assert photons_per_ray(scan) == whole
    monkeypatch.setattr("tomo_polysplat.scan.noise._MOST", scan.size // 8 + 1)
    assert photons_per_ray(scan) == some == pytest.approx(1e4, rel=0.15)


def test_the_noise_of_a_scan_is_looked_at_once(monkeypatch):
    seen = []
    monkeypatch.setattr(
        "tomo_polysplat.fit.problem.ray_noise",
        lambda rays, dimmed, **options: seen.append(rays) or RayNoise(5e4),
    )
    result = reconstruct(fan(), calibrate=True)
    assert len(seen) == 1 and result.plan["photons_per_ray"].value == pytest.approx(5e4)


def test_light_that_is_spread_correlates_the_noise_of_neighbours():
    light = np.exp(-poisson(disc(1.5), 3e4).astype(np.float64))
    # What stands still, as gains of pixels do, is none of it.
    gains = 1 + 0.02 * ndimage.gaussian_filter(np.random.default_rng(1).normal(size=light.shape[1:]), (0, 2))
    own, shared = (
        torch.from_numpy(-np.log(each * gains))
        for each in (light, ndimage.gaussian_filter(light, (0, 0.7, 0.7)))
    )
    shared[:, 3, 5] = torch.nan
    assert correlation_of_noise(own) == pytest.approx(0, abs=0.03)
    assert correlation_of_noise(shared) == pytest.approx(np.exp(-1 / (4 * 0.7**2)), abs=0.05)
    assert correlation_of_noise(shared + 0.3) == 0

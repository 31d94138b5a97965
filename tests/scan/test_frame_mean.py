"""Open-beam and dark images that gamma rays hit: a hit is left out, and noise, flicker and drift are not."""

import logging

import numpy as np
import pytest

from tomo_polysplat.scan.counts import Counts
from tomo_polysplat.scan.frame_mean import FrameMean


def _images(seed, images=10, photons=8000.0, gain=2.5, shape=(23, 37), flicker=0.0):
    rng = np.random.default_rng(seed)
    beam = photons * (1 + 0.4 * np.sin(np.arange(shape[1]) / 5)) * np.ones(shape)
    bright = 1 + flicker * rng.normal(size=images)
    return gain * rng.poisson(bright[:, None, None] * beam), gain * beam * bright.mean()


def _mean(images):
    found = FrameMean()
    for image in images:
        found.add(image)
    return found.mean("flats")


@pytest.mark.parametrize("images", [2, 3, 10])
@pytest.mark.parametrize("flicker", [0.0, 0.05])
def test_a_pixel_hit_in_one_image_goes_by_the_others(images, flicker, caplog):
    frames, beam = _images(images, images, flicker=flicker)
    clean = _mean(frames)
    np.testing.assert_array_equal(clean, frames.mean(axis=0))
    hit = frames.astype(float)
    places = ([0, 1, 1, 0], [3, 11, 20, 22], [0, 17, 36, 5])
    hit[places] += 9000
    with caplog.at_level(logging.INFO):
        found = _mean(hit)
    assert "flats: 4 pixels" in caplog.text
    # As noisy as one image fewer is, and not 9000 / images too bright.
    noise = np.sqrt(2.5 * beam / (images - 1))
    assert (np.abs(found - beam)[places[1:]] < 4 * noise[places[1:]] + 0.002 * beam[places[1:]]).all()
    assert 9000 / images > 6 * noise.max() or images > 3
    others = np.ones(beam.shape, bool)
    others[places[1:]] = False
    np.testing.assert_array_equal(found[others], clean[others])


@pytest.mark.parametrize("photons", [0.05, 2.0, 300.0])
def test_noise_of_counts_is_no_hit(photons):
    for seed in range(4):
        frames, _ = _images(seed, 7, photons, 1.0, (90, 110))
        np.testing.assert_array_equal(_mean(frames), frames.mean(axis=0))


def test_a_beam_that_wanders_is_no_hit():
    """Stripes of a multilayer that move between and during the images before and after a scan."""
    rows = np.arange(40.0)[:, None]
    shifts = [0.0, 0.1, 0.0, 0.2, 0.1, 1.4, 1.5, 1.6, 1.4, 1.5]
    rng = np.random.default_rng(5)
    frames = np.stack([rng.poisson(2e4 * (1 + 0.2 * np.sin((rows + s) * np.ones((1, 30))))) for s in shifts])
    np.testing.assert_array_equal(_mean(frames), frames.mean(axis=0))


def test_no_number_and_no_light_stay_what_they_are():
    frames = np.full((4, 3, 5), 100.0)
    frames[1, 1, 2], frames[:, 0, 0] = np.nan, 0.0
    found = _mean(frames)
    assert np.isnan(found[1, 2]) and found[0, 0] == 0
    assert (found[2] == 100).all() and (_mean(np.zeros((3, 2, 2))) == 0).all()


def test_hit_flats_and_darks_leave_no_trace_in_the_line_integrals():
    flats, beam = _images(3, 10)
    darks = np.random.default_rng(4).poisson(90, flats.shape)
    counts = np.repeat(beam[None] + 90, 3, axis=0)
    flats = flats + 90.0
    good = np.asarray(Counts.of(counts, flats, darks))
    flats[2, 5, 5] += 20000
    darks[3, 5, 6] += 20000
    found = np.asarray(Counts.of(counts, flats, darks))
    assert np.abs(found - good).max() < 0.01

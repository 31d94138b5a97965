"""Figures of merit against numbers worked out by hand."""

import math

import numpy as np
import pytest

from tomo_polysplat.result.metrics import compare


def cube(seed=0, shape=(9, 11, 10)):
    truth = np.random.default_rng(seed).random(shape)
    truth[0, 5, 5] = 1.0
    return truth


def test_a_constant_error_has_a_known_psnr():
    truth = cube()
    found = compare(truth + 0.01, truth)
    assert found["psnr"] == pytest.approx(20 * math.log10(1 / 0.01))
    assert found["psnr_all"] == pytest.approx(found["psnr"])
    assert found["rmse"] == pytest.approx(0.01)


def test_metal_counts_in_psnr_all_only():
    truth, metal = cube(), np.zeros((9, 11, 10), bool)
    metal[2, 3, 4] = True
    truth[metal] = 20.0
    volume = truth + 0.01
    volume[metal] = 12.0
    found = compare(volume, truth, metal)
    assert found["psnr"] == pytest.approx(40.0)
    rms = math.sqrt((8.0**2 + 0.01**2 * (truth.size - 1)) / truth.size)
    assert found["psnr_all"] == pytest.approx(20 * math.log10(20 / rms))
    assert found["rmse"] == pytest.approx(0.01)
    volume[metal] = -100.0
    again = compare(volume, truth, metal)
    assert again["ssim"] == found["ssim"] and again["psnr"] == found["psnr"]
    assert again["psnr_all"] < found["psnr_all"]


def test_a_perfect_volume():
    found = compare(cube(), cube())
    assert found["psnr"] == found["psnr_all"] == math.inf
    assert found["ssim"] == pytest.approx(1.0) and found["rmse"] == 0


def test_ssim_falls_with_noise_and_takes_a_slice_as_an_image():
    truth = cube(shape=(1, 24, 31))
    noise = np.random.default_rng(1).normal(size=truth.shape)
    scores = [compare(truth + amount * noise, truth)["ssim"] for amount in (0.0, 0.05, 0.2)]
    assert scores == sorted(scores, reverse=True) and scores[2] < 0.95
    assert compare(truth[0] + 0.05 * noise[0], truth[0])["ssim"] == pytest.approx(scores[1])


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_ssim_of_two_slices_is_their_mean(axis):
    rng = np.random.default_rng(3)
    truth, noise = np.abs(rng.normal(size=(2, 2, 9, 11)))
    volume = truth + np.array([0.05, 0.4])[:, None, None] * noise
    truth[0, 0, 0] = truth[1, 0, 0] = 4.0  # the same range in both
    alone = [compare(volume[k], truth[k])["ssim"] for k in (0, 1)]
    both = compare(np.moveaxis(volume, 0, axis), np.moveaxis(truth, 0, axis))
    assert both["ssim"] == pytest.approx(np.mean(alone)) and alone[0] > alone[1]


def test_what_does_not_depend_on_the_unit():
    truth = cube()
    volume = truth + np.random.default_rng(2).normal(0, 0.05, truth.shape)
    in_cm, in_um = compare(volume, truth), compare(volume * 1e-4, truth * 1e-4)
    for name in ("psnr", "psnr_all", "ssim"):
        assert in_um[name] == pytest.approx(in_cm[name]), name
    assert in_um["rmse"] == pytest.approx(1e-4 * in_cm["rmse"])


@pytest.mark.parametrize(
    ("volume", "truth", "metal", "message"),
    [
        (np.ones((3, 4, 5)), np.ones((3, 5, 4)), None, "volume: expected shape"),
        (np.full((3, 4, 5), np.nan), np.ones((3, 4, 5)), None, "finite"),
        (np.ones((3, 4, 5)), np.ones((3, 4, 5)), np.ones((3, 4, 5), bool), "not metal"),
        (np.ones((3, 4, 5)), np.zeros((3, 4, 5)), None, "positive largest value"),
        (np.ones((2, 2, 5)), np.ones((2, 2, 5)), None, "at least 3 voxels"),
    ],
)
def test_what_cannot_be_compared_is_refused(volume, truth, metal, message):
    with pytest.raises(ValueError, match=message):
        compare(volume, truth, metal)

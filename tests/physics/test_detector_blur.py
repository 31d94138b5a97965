"""The detector's blur against convolution, its limits, and its gradient."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from tomo_polysplat.physics.detector_blur import LARGEST_BLUR, blurred, blurred_light
from tomo_polysplat.settings import Settings


def image(views=2, rows=7, columns=9, largest=3.0):
    generator = torch.Generator().manual_seed(4)
    return largest * torch.rand((views, rows, columns), generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("variance", [0.0, 1 / 12, 0.4])
def test_projections_are_convolved(variance):
    taps = [variance / 2, 1 - variance, variance / 2]
    expected = image().numpy()
    for axis in (1, 2):
        expected = ndimage.convolve1d(expected, taps, axis=axis, mode="nearest")
    got = blurred(image(), torch.tensor([variance], dtype=torch.float64))
    np.testing.assert_allclose(got.numpy(), expected, rtol=1e-12)


def test_the_variance_is_that_of_the_spread_attenuation():
    """A single ray through matter: what it has lost is kept, and spread as far as said."""
    single = torch.zeros((1, 11, 13), dtype=torch.float64)
    single[0, 5, 6] = 1.0
    spread = blurred(single, torch.tensor([0.35], dtype=torch.float64))[0].numpy()
    rows, columns = np.mgrid[-5:6, -6:7]
    assert spread.sum() == pytest.approx(1, rel=1e-12)
    assert (spread * rows**2).sum() == pytest.approx(0.35, rel=1e-9)
    assert (spread * columns**2).sum() == pytest.approx(0.35, rel=1e-9)


def test_a_line_detector_is_blurred_along_its_line_only():
    variance = torch.tensor([0.3])
    flat = torch.ones((3, 1, 5))
    torch.testing.assert_close(blurred(flat, variance), flat)
    torch.testing.assert_close(blurred(torch.ones((1, 1, 1)), variance), torch.ones((1, 1, 1)))


def test_a_setting_starts_from_any_blur_that_is_fitted():
    assert Settings(blur=LARGEST_BLUR).blur == LARGEST_BLUR
    with pytest.raises(ValueError, match="blur"):
        Settings(blur=1.001 * LARGEST_BLUR)


@pytest.mark.parametrize("variance", [0.05, LARGEST_BLUR])
def test_gradients(variance):
    rays = image(1, 4, 5).requires_grad_()
    spread = torch.tensor([variance], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(blurred, (rays, spread))


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 1, 5), (2, 4, 1), (3, 2, 9), (2, 7, 41)])
def test_lanes_of_float32_blur_as_float64_does(shape):
    found = []
    for kind in (torch.float64, torch.float32):
        rays, spread = (
            image(*shape).to(kind).requires_grad_(),
            torch.tensor([0.23], dtype=kind, requires_grad=True),
        )
        value = blurred(rays, spread)
        (value * image(*shape).square().to(kind)).sum().backward()
        slope = torch.zeros(1) if spread.grad is None else spread.grad
        found.append([part.double() for part in (value.detach(), rays.grad, slope)])
    for one, other in zip(*found):
        torch.testing.assert_close(one, other, rtol=1e-5, atol=1e-5)


# Light


@pytest.mark.parametrize("variance", [0.0, 1 / 12, 0.4])
def test_light_is_convolved(variance):
    taps = [variance / 2, 1 - variance, variance / 2]
    expected = np.exp(-image(largest=7.0).numpy())
    for axis in (1, 2):
        expected = ndimage.convolve1d(expected, taps, axis=axis, mode="nearest")
    got = blurred_light(image(largest=7.0), torch.tensor([variance], dtype=torch.float64))
    np.testing.assert_allclose(got.numpy(), -np.log(expected), rtol=1e-12, atol=1e-12)


def test_light_beside_an_opaque_pixel_is_finite_and_no_blur_changes_nothing():
    opaque = image(1, 5, 7).float()
    opaque[0, 2, 3] = 500.0
    torch.testing.assert_close(blurred_light(opaque, torch.zeros(1)), opaque, rtol=0, atol=0)
    spread = blurred_light(opaque.requires_grad_(), variance := torch.tensor([0.4], requires_grad=True))
    spread.sum().backward()
    assert all(bool(torch.isfinite(each).all()) for each in (spread, opaque.grad, variance.grad))


@pytest.mark.parametrize("variance", [0.05, LARGEST_BLUR])
def test_gradients_of_light(variance):
    rays = image(1, 4, 5, largest=6.0).requires_grad_()
    spread = torch.tensor([variance], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(blurred_light, (rays, spread))

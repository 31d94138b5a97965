"""The detector's blur against convolution, its limits, and its gradient."""

import numpy as np
import pytest
import torch
from scipy import ndimage

from tomo_polysplat.physics.detector_blur import LARGEST_BLUR, blurred
from tomo_polysplat.settings import Settings


def image(views=2, rows=7, columns=9, largest=3.0):
    generator = torch.Generator().manual_seed(4)
    return largest * torch.rand((views, rows, columns), generator=generator, dtype=torch.float64)


@pytest.mark.parametrize("variance", [0.0, 1 / 12, 0.4])
def test_intensities_are_convolved(variance):
    taps = [variance / 2, 1 - variance, variance / 2]
    light = np.exp(-image().numpy())
    for axis in (1, 2):
        light = ndimage.convolve1d(light, taps, axis=axis, mode="nearest")
    got = blurred(image(), torch.tensor([variance], dtype=torch.float64))
    np.testing.assert_allclose(got.numpy(), -np.log(light), rtol=1e-12)


def test_the_variance_is_that_of_the_spread_light():
    """A single bright pixel on an opaque detector: its light is kept, and spread as far as said."""
    opaque = torch.full((1, 11, 13), 60.0, dtype=torch.float64)
    opaque[0, 5, 6] = 0.0
    light = torch.exp(-blurred(opaque, torch.tensor([0.35], dtype=torch.float64)))[0].numpy()
    rows, columns = np.mgrid[-5:6, -6:7]
    assert light.sum() == pytest.approx(1, rel=1e-12)
    assert (light * rows**2).sum() == pytest.approx(0.35, rel=1e-9)
    assert (light * columns**2).sum() == pytest.approx(0.35, rel=1e-9)


def test_a_line_detector_is_blurred_along_its_line_only():
    variance = torch.tensor([0.3])
    flat = torch.ones((3, 1, 5))
    torch.testing.assert_close(blurred(flat, variance), flat)
    torch.testing.assert_close(blurred(torch.ones((1, 1, 1)), variance), torch.ones((1, 1, 1)))


def test_opaque_rays_stay_finite():
    """A step from open beam to rays that float32's exponential cannot hold."""
    step = torch.zeros((1, 3, 8))
    step[..., 4:] = 500.0
    step.requires_grad_()
    variance = torch.tensor([0.2], requires_grad=True)
    seen = blurred(step, variance)
    seen.sum().backward()
    assert all(bool(torch.isfinite(t).all()) for t in (seen, step.grad, variance.grad))
    assert float(seen[0, 0, -1].detach()) == 500


def test_a_setting_starts_from_any_blur_that_is_fitted():
    assert Settings(blur=LARGEST_BLUR).blur == LARGEST_BLUR
    with pytest.raises(ValueError, match="blur"):
        Settings(blur=1.001 * LARGEST_BLUR)


@pytest.mark.parametrize("variance", [0.05, LARGEST_BLUR])
def test_gradients(variance):
    rays = image(1, 4, 5).requires_grad_()
    spread = torch.tensor([variance], dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(blurred, (rays, spread))

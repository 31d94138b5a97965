"""Light that is averaged over a pixel, in closed form."""

import math

import pytest
import torch

from tomo_polysplat.physics.pixel_light import averaged_light


def test_a_uniform_pixel_is_as_its_rays_are():
    projections = torch.tensor([[0.3, 4.0], [400.0, -0.2]], dtype=torch.float64)
    fine = projections.repeat_interleave(3, dim=0).repeat_interleave(3, dim=1)
    torch.testing.assert_close(averaged_light(fine[None], 2, 2)[0], projections)


@pytest.mark.parametrize("metal", [0.5, 6.0, 400.0])
def test_light_passes_beside_metal_that_covers_half_of_a_pixel(metal):
    fine = torch.zeros((1, 2, 10), dtype=torch.float64)
    fine[:, :, 5:] = metal
    expected = -math.log(0.5 + 0.5 * math.exp(-metal))
    got = averaged_light(fine, 1, 1)
    assert float(got) == pytest.approx(expected, rel=1e-12)
    assert float(got) < 0.5 * metal, "less than the mean of the line integrals"


def test_its_gradient():
    generator = torch.Generator().manual_seed(1)
    fine = 3 * torch.rand((2, 6, 4), dtype=torch.float64, generator=generator).requires_grad_()
    assert torch.autograd.gradcheck(lambda values: averaged_light(values, 3, 2), fine)

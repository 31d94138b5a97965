"""The SSIM term against scikit-image and its limits."""

import pytest
import torch
from skimage.metrics import structural_similarity

from tomo_polysplat.fit.similarity import dissimilarity


def images(rows=23, columns=31):
    generator = torch.Generator().manual_seed(5)
    measured = torch.rand((2, rows, columns), generator=generator, dtype=torch.float64)
    return measured + 0.2 * torch.rand(measured.shape, generator=generator, dtype=torch.float64), measured


def test_equal_images_are_not_dissimilar():
    _, measured = images()
    assert float(dissimilarity(measured, measured, torch.ones_like(measured))) == pytest.approx(0, abs=1e-12)


def test_it_is_one_minus_what_scikit_image_finds():
    predicted, measured = images()
    expected = []
    for p, m in zip(predicted.numpy(), measured.numpy()):
        span = float(measured.max())
        _, whole = structural_similarity(
            p, m, data_range=span, win_size=7, use_sample_covariance=False, full=True
        )
        expected.append(1 - whole[3:-3, 3:-3].mean())
    value = float(dissimilarity(predicted, measured, torch.ones_like(measured)))
    assert value == pytest.approx(sum(expected) / 2, rel=1e-6)


def test_unusable_rays_do_not_count():
    predicted, measured = images()
    usable = torch.ones_like(measured)
    usable[:, 4:9, 11] = 0
    spoilt = torch.where(usable > 0, measured, torch.full_like(measured, 0.9))
    assert float(dissimilarity(predicted, spoilt, usable)) == float(
        dissimilarity(predicted, measured, usable)
    )


def test_its_gradient_is_right():
    predicted, measured = images(9, 8)
    assert torch.autograd.gradcheck(
        lambda p: dissimilarity(p, measured, torch.ones_like(measured)), predicted.requires_grad_()
    )

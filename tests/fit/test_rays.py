"""Which rays are used, held out and how they are weighted."""

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.kernels.views import DetectorViews


def rays(values, photons=float("inf"), model_error=0.01, held_out=0.05):
    views = len(values)
    matrix = np.broadcast_to(np.eye(3), (views, 3, 3))
    detector = DetectorViews(False, np.zeros((views, 3)), matrix, *values.shape[1:])
    return Rays(torch.as_tensor(values), detector, photons, model_error, held_out)


SHAPE = (12, 20, 31)


def batch(of, chosen=range(SHAPE[0])):
    return of.batch(np.array(list(chosen)))


def test_held_out_rays_are_the_stated_share_and_never_fitted():
    _, _, weight, aside = batch(rays(np.zeros(SHAPE, np.float32), held_out=0.2))
    assert not bool((weight.bool() & aside.bool()).any())
    assert bool((weight.bool() | aside.bool()).all())
    share = float(aside.bool().float().mean())
    # Three standard deviations of as many independent draws.
    assert share == pytest.approx(0.2, abs=3 * np.sqrt(0.2 * 0.8 / np.prod(SHAPE)))


def test_the_choice_is_the_same_every_time_and_in_any_batch():
    of = rays(np.zeros(SHAPE, np.float32))
    whole = batch(of)[3]
    assert torch.equal(whole, batch(rays(np.zeros(SHAPE, np.float32)))[3])
    assert torch.equal(batch(of, [7, 2])[3], whole[[7, 2]])


def test_every_view_holds_out_other_pixels():
    aside = batch(rays(np.zeros(SHAPE, np.float32), held_out=0.2))[3].bool().flatten(1).double()
    correlation = np.corrcoef(aside.numpy())
    np.fill_diagonal(correlation, 0)
    # Independent choices of 620 pixels correlate by 1/sqrt(620) = 0.04.
    assert np.abs(correlation).max() < 0.2


def test_neither_rows_nor_columns_are_preferred():
    aside = batch(rays(np.zeros((60, 24, 24), np.float32), held_out=0.2), range(60))[3].bool().double()
    for axes in ((0, 1), (0, 2)):
        share = aside.mean(dim=axes)
        assert float((share - 0.2).abs().max()) < 4 * np.sqrt(0.2 * 0.8 / (60 * 24))


def test_the_choice_is_that_of_whole_numbers_without_an_end():
    """On every device, so that a run goes on elsewhere by the same rays: here by Python's own numbers."""
    shape = (3, 5, 7)
    aside = rays(np.zeros(shape, np.float32), held_out=0.3).aside(np.array([2, 0]))
    for k, view in enumerate((2, 0)):
        for pixel in range(5 * 7):
            mixed = (pixel * 2654435761 + view * 40503 + 12345) % 2**32
            mixed = (mixed ^ (mixed >> 15)) * 2246822519 % 2**32
            assert bool(aside[k].flatten()[pixel]) == ((mixed >> 16) < int(0.3 * 65536))


def test_nothing_is_held_out_when_nothing_is_asked_for():
    _, _, weight, aside = batch(rays(np.zeros(SHAPE, np.float32), held_out=0.0))
    assert not bool(aside.any()) and bool((weight == 1).all())


def test_unusable_rays_have_no_weight_and_a_harmless_value():
    values = np.ones(SHAPE, np.float32)
    values[3, 4, 5:9] = np.nan
    values[0, 0, 0] = np.inf
    _, kept, weight, aside = batch(rays(values, photons=1e4))
    bad = torch.as_tensor(~np.isfinite(values))
    assert bool((kept[bad] == 0).all()) and not bool(weight[bad].any()) and not bool(aside[bad].any())
    assert bool(torch.isfinite(kept).all())


def test_weights_are_inverse_deviations_of_noise_and_model_together():
    p = np.linspace(-0.1, 6, 31, dtype=np.float32) * np.ones(SHAPE, np.float32)
    _, _, weight, aside = batch(rays(p, photons=2e4, model_error=0.02))
    deviation = np.sqrt(0.02**2 + np.exp(p.astype(np.float64)) / 2e4)
    assert np.allclose((weight + aside).numpy(), 0.02 / deviation, rtol=1e-5)


def test_opaque_rays_do_not_overflow():
    _, _, weight, aside = batch(rays(np.full(SHAPE, 700.0, np.float32), photons=1e4))
    assert not bool(weight.any()) and not bool(aside.any())

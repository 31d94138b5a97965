"""Sums of residuals against loops over the rays."""

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.residual_sums import residual_sums
from tomo_polysplat.fit.taken_out import TakenOut
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.settings import Settings

VIEWS, ROWS, COLUMNS, PREDICTED = 19, 5, 7, 0.4


class FlatScene:
    """Predicts the same for every ray."""

    device = "cpu"

    def projections(self, gaussians, views):
        return torch.full((len(views), ROWS, COLUMNS), PREDICTED, device=self.device), 0


def rays(values, held_out=0.2):
    views = DetectorViews(True, np.zeros((VIEWS, 3)), np.zeros((VIEWS, 3, 3)), ROWS, COLUMNS)
    return Rays(torch.from_numpy(values), views, 1e4, 0.015, held_out)


def measured():
    values = np.random.default_rng(0).normal(PREDICTED, 0.01, (VIEWS, ROWS, COLUMNS)).astype(np.float32)
    values[3, 1, 2] = values[:, 4, 4] = np.nan
    return values


def test_every_usable_ray_is_counted_once():
    values = measured()
    sums = residual_sums(None, FlatScene(), rays(values), Settings())
    assert sums.count.sum() + len(sums.residual) == np.isfinite(values).sum()
    assert not sums.weight[:, 4, 4].any()
    left = values[sums.view, sums.pixel // COLUMNS, sums.pixel % COLUMNS] - PREDICTED
    np.testing.assert_allclose(sums.residual, left, atol=1e-6)
    aside = np.zeros(values.shape, bool)
    aside[sums.view, sums.pixel // COLUMNS, sums.pixel % COLUMNS] = True
    fitted = np.where(aside | np.isnan(values), 0.0, values - PREDICTED)
    np.testing.assert_allclose(sums.by_depth.sum(axis=(0, 2)), fitted.sum(axis=(1, 2)), atol=1e-5)


@pytest.mark.gpu
@pytest.mark.parametrize("streamed", [False, True])
def test_a_gpu_sums_the_same_rays(streamed):
    scene, some = FlatScene(), rays(measured())
    expected = residual_sums(None, scene, some, Settings())
    scene.device = some.device = torch.device("cuda", 0)
    some.projections = some.projections if streamed else some.projections.cuda()
    found, again = (residual_sums(None, scene, some, Settings()) for _ in range(2))
    for name in ("weight", "total", "count", "by_depth", "view", "pixel", "residual", "deviation"):
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=1e-5, atol=1e-7)
    assert np.array_equal(found.total, again.total), "what gains are told by depends on no order"


def test_few_rays_at_once_give_the_same_sums(monkeypatch):
    expected = residual_sums(None, FlatScene(), rays(measured()), Settings())
    monkeypatch.setattr("tomo_polysplat.fit.residual_sums._RAYS", 3 * ROWS * COLUMNS)
    found = residual_sums(None, FlatScene(), rays(measured()), Settings())
    for name in ("weight", "total", "count", "by_depth", "view", "pixel", "residual", "deviation"):
        assert np.array_equal(getattr(found, name), getattr(expected, name)), name


def test_a_light_that_is_taken_out_of_sums_is_that_of_the_rays():
    values, drift = measured(), np.repeat(np.linspace(-0.01, 0.01, 8), [3, 2, 3, 2, 2, 3, 2, 2])
    before = residual_sums(None, FlatScene(), rays(values), Settings())
    after = residual_sums(
        None, FlatScene(), rays((values - drift[:, None, None]).astype(np.float32)), Settings()
    )
    told = before.without_drift(drift)
    np.testing.assert_allclose(told.residual, after.residual, atol=1e-6)
    np.testing.assert_allclose(told.by_depth.sum(axis=2), after.by_depth.sum(axis=2), atol=1e-4)
    np.testing.assert_allclose(told.total, after.total, atol=2e-3)


def test_what_is_taken_out_is_kept_in_order():
    values = torch.zeros((VIEWS, ROWS, COLUMNS))
    taken = TakenOut(tuple(values.shape), [], lambda: [values])
    gains, drift = np.full((ROWS, COLUMNS), 0.25), np.arange(VIEWS) / 4
    taken.add(gains=gains)
    taken.add(drift=drift)
    assert np.array_equal(values.numpy(), np.broadcast_to(-0.25 - drift[:, None, None], values.shape))
    assert np.array_equal(taken.gains, gains) and np.array_equal(taken.drift, drift)
    order = np.roll(np.arange(VIEWS), 5)
    assert np.array_equal(taken.told(order)["drift"][order], drift.astype(np.float32))


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
def test_weights_follow_what_is_taken_out_at_the_same_address(device):
    """A recorded step reads them there; a run that goes on from a checkpoint makes them of the corrected rays."""
    some = rays(measured())
    some.projections = some.projections.to(device)
    totals, before = some.totals, (some.totals.clone(), some.typical_weight)
    taken = TakenOut(tuple(some.projections.shape), [], lambda: [some.projections])
    taken.add(drift=np.linspace(-0.5, 0.5, VIEWS))
    some.weigh_anew()
    fresh = rays(some.projections.cpu().numpy())
    fresh.projections = some.projections
    assert some.totals is totals and torch.equal(totals, fresh.totals)
    assert some.typical_weight == fresh.typical_weight != before[1]
    assert not torch.equal(totals, before[0])


def test_some_views_are_summed_as_if_there_were_no_others():
    values, some = measured(), np.array([1, 4, 5, 11, 17])
    whole = residual_sums(None, FlatScene(), rays(values), Settings())
    part = residual_sums(None, FlatScene(), rays(values), Settings(), some)
    assert np.array_equal(part.views, some) and np.array_equal(part.count, whole.count[:, some])
    assert np.array_equal(part.by_depth, whole.by_depth[:, some])
    theirs = np.isin(whole.view, some)
    assert np.array_equal(part.residual, whole.residual[theirs])
    assert np.array_equal(some[part.view], whole.view[theirs])

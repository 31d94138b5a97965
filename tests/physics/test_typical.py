"""The median of typical rays, told without a copy, is the median that sorting gives."""

import numpy as np
import pytest
import torch

from tomo_polysplat.physics import typical
from tomo_polysplat.physics.typical import largest_finite, typical_value


def sorted_out(values):
    """The same by picking out and sorting."""
    finite = values[np.isfinite(values)]
    inside = np.sort(finite[finite > values.dtype.type(0.1) * max(finite.max(), 0)])
    return None if not len(inside) else float(inside[(len(inside) - 1) // 2])


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("kind", ["exponential", "few", "tiny", "below zero"])
def test_it_is_what_sorting_gives(monkeypatch, dtype, kind):
    monkeypatch.setattr(typical, "_CHUNK", 100)
    for seed in range(8):
        rng = np.random.default_rng(seed)
        values = rng.exponential(1.0, (3, 7, 50 + seed)).astype(dtype)
        if kind == "few":
            values = np.round(values * 3)
        if kind == "tiny":
            values *= dtype(1e-30)
        if kind == "below zero":
            values = -values
        values[rng.random(values.shape) < 0.1] = np.nan
        values[0, 0, :3] = np.inf, -np.inf, np.nan
        for few in (0, len(values.ravel())):
            monkeypatch.setattr(typical, "_FEW", few)
            assert typical_value(torch.from_numpy(values)) == sorted_out(values)
        assert float(largest_finite(torch.from_numpy(values))) == values[np.isfinite(values)].max()


def test_of_nothing_there_is_none():
    for values in (torch.zeros(0), torch.zeros(5), torch.full((4,), np.nan)):
        assert typical_value(values) is None
    assert float(largest_finite(torch.zeros(0))) == -np.inf
    assert typical_value(torch.tensor([1, 2, 3])) == 2.0

"""The least and the largest of rays, with what is no number among them, against sorted values."""

import numpy as np
import pytest

from tomo_polysplat.scan.extremes import largest, least


@pytest.mark.parametrize("views", [3, 400])
def test_they_are_the_ends_of_sorted_values(views):
    random = np.random.default_rng(views)
    values = random.integers(-50, 50, (views, 40, 80)).astype(np.float32)
    values[0], values[1, ::2], values[2, 0, 0] = np.nan, np.inf, -np.inf
    told = np.sort(values[np.isfinite(values)])
    assert least(values) == -np.inf and largest(values) == np.inf
    assert least(values, above=-np.inf) == told[0] and largest(values, below=np.inf) == told[-1]
    assert least(values, above=told[0]) == told[told > told[0]][0]
    assert largest(values, below=told[-1]) == told[told < told[-1]][-1]


def test_where_there_is_none_nothing_is_below():
    nothing = np.full((2, 3, 4), np.nan, np.float32)
    assert least(nothing) == np.inf and largest(nothing, below=1.0) == -np.inf
    assert least(np.ones((2, 3, 4)), above=1.0) == np.inf and least(np.ones((0, 3, 4))) == np.inf

"""Some of many views: rising, at most so many, from the first to the last."""

import numpy as np
import pytest

from tomo_polysplat.evenly_spread import evenly_spread


@pytest.mark.parametrize(("count", "most"), [(1, 5), (2, 2), (7, 100), (100, 7), (1001, 24)])
def test_from_the_first_to_the_last_in_steps_that_differ_by_one_at_most(count, most):
    some = evenly_spread(count, most)
    assert len(some) == min(count, most) and some[0] == 0 and some[-1] == count - 1
    assert np.ptp(np.diff(some)) <= 1 if len(some) > 1 else count == 1

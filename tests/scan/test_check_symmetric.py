"""`check` of objects and noise that tell nothing about directions and orders."""

from dataclasses import replace

import numpy as np
import pytest
from one_probe import answer

from tomo_polysplat.scan.probes.order import _shows
from tomo_polysplat.simulate.scenes import simulate_scan


@pytest.mark.parametrize("size, views, seed", [(28, 73, 5), (24, 53, 6), (24, 53, 0)])
def test_an_object_that_is_its_mirror_image_tells_no_direction(size, views, seed):
    scan = simulate_scan("pins", size, views, geometry="fan", metal=False, photons=3e4, seed=seed)
    assert str(answer(scan, "direction of the angles").verdict) == "unknown"


class _Noise:
    """Squared differences of views with as much error each."""

    def error(self, squared):
        return np.full(np.shape(squared), 4e-4)


@pytest.mark.parametrize("between, misplaced", [(1e-5, True), (-4.5e-3, False)])
def test_a_difference_far_below_nothing_says_that_the_noise_is_not_known(between, misplaced):
    nearer, between, like = np.array([[3e-3], [between], [-1.1e-3]])
    assert _shows(_Noise(), nearer, between, like, 1e-4, 1.3e-2).tolist() == [misplaced]


def test_one_view_of_few_photons_at_the_border_is_no_object():
    scan = simulate_scan("pins", 24, 48, geometry="fan", metal=False, photons=1e5)
    for views, told in ((1, "ok"), (3, "defect")):
        values = scan.projections.copy()
        values[:, 7 : 7 + views, :2] += 0.9
        assert str(answer(replace(scan, projections=values), "truncation").verdict) == told

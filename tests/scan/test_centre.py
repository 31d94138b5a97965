"""The rotation axis from the data, for whole, half and shuffled turns."""

import tracemalloc

import numpy as np
import pytest
from discs import CENTRE, COLUMNS, ROWS, discs

from tomo_polysplat.scan.centre import estimate_centre


@pytest.mark.parametrize(
    "theta",
    [
        np.linspace(0, 180, 91),
        np.linspace(0, 180, 90, endpoint=False),
        np.linspace(-30, 330, 120, endpoint=False),
        np.random.default_rng(0).permutation(np.linspace(0, 180, 61)),
        np.repeat(np.linspace(0, 180, 60, endpoint=False), 2),
    ],
    ids=["half turn", "last angle left out", "full turn", "shuffled", "each angle twice"],
)
@pytest.mark.parametrize("centre", [CENTRE, 31.5, 38.75])
def test_rotation_axis_is_found(theta, centre):
    angles = np.deg2rad(theta)
    noise = np.random.default_rng(1).normal(0, 0.01, (ROWS, len(angles), COLUMNS))
    assert estimate_centre(discs(angles, centre=centre) + noise, angles) == pytest.approx(centre, abs=0.15)


@pytest.mark.parametrize("share", [1e-3, 1e-2])
def test_rotation_axis_is_found_where_every_column_has_bad_rays(share):
    """Saturated rays all over, and a dead column; what they hold must not matter."""
    angles = np.deg2rad(np.linspace(0, 180, 180, endpoint=False))
    rng = np.random.default_rng(2)
    projections = np.repeat(discs(angles), 10, axis=0) + rng.normal(0, 0.01, (20, 180, COLUMNS))
    valid = rng.random(projections.shape) >= share
    valid[:, :, 17] = False
    for filler in (50.0, np.nan):
        found = estimate_centre(np.where(valid, projections, filler), angles, valid)
        assert found == pytest.approx(CENTRE, abs=0.1)


def test_rotation_axis_of_a_wide_detector_takes_little_memory():
    """The pairs that are compared are chosen before they are interpolated, and there are 16 of them."""
    angles = np.deg2rad(np.linspace(0, 360, 1201, endpoint=False))
    projections = discs(angles, columns=1501, centre=731.3).astype(np.float32)
    tracemalloc.start()
    try:
        assert estimate_centre(projections, angles) == pytest.approx(731.3, abs=0.15)
        assert tracemalloc.get_traced_memory()[1] < projections.nbytes
    finally:
        tracemalloc.stop()


def test_rotation_axis_needs_opposite_views():
    angles = np.linspace(0, 2.0, 30)
    with pytest.raises(ValueError, match=r"half a turn apart.*centre="):
        estimate_centre(discs(angles), angles)


def test_rotation_axis_needs_something_in_the_beam():
    angles = np.linspace(0, np.pi, 30)
    projections = discs(angles)
    for values, valid in ((0 * projections, None), (projections, np.zeros(projections.shape, bool))):
        with pytest.raises(ValueError, match=r"object in the beam.*centre="):
            estimate_centre(values, angles, valid)

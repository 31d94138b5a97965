"""The rotation axis from the data, for whole, half and shuffled turns."""

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
    ],
    ids=["half turn", "last angle left out", "full turn", "shuffled"],
)
@pytest.mark.parametrize("centre", [CENTRE, 31.5, 38.75])
def test_rotation_axis_is_found(theta, centre):
    angles = np.deg2rad(theta)
    noise = np.random.default_rng(1).normal(0, 0.01, (ROWS, len(angles), COLUMNS))
    assert estimate_centre(discs(angles, centre=centre) + noise, angles) == pytest.approx(centre, abs=0.15)


def test_rotation_axis_needs_opposite_views():
    angles = np.linspace(0, 2.0, 30)
    with pytest.raises(ValueError, match=r"half a turn apart.*centre="):
        estimate_centre(discs(angles), angles)

"""A scan of air is said to show no object; a faint or small object is one."""

import logging
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from tomo_polysplat.plan.no_object import doubt_object
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.scan.noise import photons_per_ray

PHOTONS = 1e4


@pytest.mark.parametrize(
    "depth, width, told", [(0.0, 0, True), (0.02, 16, False), (0.3, 2, False), (3.0, 1, False)]
)
def test_air_alone_is_no_object(depth, width, told, caplog):
    """Deviations of the noise are 0.01: -log(I/I0) of 2, or 30 on few of the rays."""
    light = np.full((30, 20, 48), 1.0)
    light[:, 8 : 8 + width, 20 : 20 + width] = np.exp(-depth)
    counts = np.random.default_rng(1).poisson(PHOTONS * light)
    projections = -np.log(counts / PHOTONS).astype(np.float32)
    projections[3, 4, 5] = np.nan
    plan, problem = Plan(), cast("Any", SimpleNamespace(projections=projections, filter_map=None))
    with caplog.at_level(logging.WARNING):
        doubt_object(problem, plan, photons_per_ray(projections))
    assert ("object" in plan.facts) == told == ("show no object" in caplog.text)


def test_rays_without_noise_are_not_judged():
    plan, problem = Plan(), cast("Any", SimpleNamespace(projections=np.zeros((9, 4, 9)), filter_map=None))
    doubt_object(problem, plan, float("inf"))
    assert not plan.facts

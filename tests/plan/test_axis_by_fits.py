"""The axis of rotation where no ray was measured from both ends: short fits tell it, or say that they cannot."""

from dataclasses import dataclass, field
from functools import cache

import numpy as np
import pytest
import torch

import tomo_polysplat as tps
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan import axis, axis_by_fits
from tomo_polysplat.plan.axis_by_fits import joined_columns
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.layout import vector_form
from tomo_polysplat.settings import make_settings

OPTIONS = FitOptions(make_settings("balanced", None), None, 0, torch.device("cpu"))
VIEWS = 47


@dataclass
class Curve:
    """Fits whose misfit depends on the place of the axis as a function says, in views that differ."""

    shape: object
    factor: int = 2
    noise: float = 0.0
    asked: list = field(default_factory=list)
    rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(3))

    def __post_init__(self):
        self.views = self.rng.uniform(0.5, 1.5, VIEWS)

    def misfits(self, place):
        self.asked.append(place)
        return self.views * (2.0 + self.shape(place)) + self.noise * self.rng.normal(size=VIEWS)


@pytest.mark.parametrize("true", [-3.17, 0.0, 0.23, 1.9])
def test_a_parabola_is_found_at_its_vertex(true):
    found = axis_by_fits._least(Curve(lambda place: (place - true) ** 2), 0.0, 0.05, 10.0)
    assert found.columns == pytest.approx(true, abs=1e-6) and found.error < 1e-6


@pytest.mark.parametrize("true", [-2.4, 0.11, 0.3, 5.0])
def test_a_wedge_is_found_to_a_twentieth_of_what_is_joined(true):
    found = axis_by_fits._least(Curve(lambda place: abs(place - true)), 0.0, 0.05, 10.0)
    assert found.columns == pytest.approx(true, abs=0.05 * 2)


@pytest.mark.parametrize("shape", [lambda place: -place / 10, lambda place: 0.0])
def test_what_falls_to_the_end_or_stays_level_tells_nothing(shape):
    curve = Curve(shape, noise=0.1)
    found = axis_by_fits._least(curve, 0.0, 0.05, 6.0)
    assert "as well 6 columns away" in found.doubt and found.error == np.inf and len(curve.asked) < 40


def test_the_standard_error_is_that_of_the_noise():
    """Over draws of the noise, and of the parabola's least place as the views tell it."""
    rng = np.random.default_rng(5)
    found = [
        axis_by_fits._Three(Curve(lambda place: place**2, noise=0.05, rng=rng), 0.0, 0.8).vertex()
        for _ in range(300)
    ]
    spread = np.std([one.columns for one in found])
    assert np.sqrt(np.mean([one.error**2 for one in found])) == pytest.approx(spread, rel=0.2)


@pytest.mark.parametrize(
    "columns, factors",
    [(20, [1]), (50, [2, 1]), (95, [2, 1]), (96, [4, 2]), (384, [16, 8, 4, 2]), (1536, [64, 32, 16, 8])],
)
def test_pixels_become_finer_down_to_what_a_fit_can_take(columns, factors):
    assert joined_columns(columns) == factors


@cache
def pins(turn):
    return tps.simulate_scan("pins", size=17, views=VIEWS, geometry="parallel", arc_degrees=turn, photons=1e5)


def found(turn, off):
    """What is found of pins, seen in parallel rays over so many degrees, told so many columns off."""
    scan = pins(turn)
    told = dict(vector_form(scan.proj_geom))
    vectors = np.array(told["Vectors"])
    vectors[:, 3:6] -= off * vectors[:, 6:9]
    values = np.ascontiguousarray(scan.projections.transpose(1, 0, 2))
    geometry = from_astra(told | {"Vectors": vectors}, scan.vol_geom)
    problem = Problem.of(values, *geometry, scan.unit, scan.spectrum, None)
    return axis.find_axis(problem, OPTIONS, lambda *_: None)


def test_less_than_half_a_turn_tells_the_axis_by_fits(monkeypatch):
    monkeypatch.setattr(axis_by_fits, "_STEPS", 60)  # half of them tell it of so few pixels
    right, wrong = found(150.0, 0.0), found(150.0, 0.7)
    assert right.value == {} and "where it was told" in right.why and axis.is_known(right)
    assert wrong.value["u"] == pytest.approx(0.7, abs=0.1) and "short fits" in wrong.why
    assert wrong.evidence["better"] > 0.1


def test_an_object_that_can_take_the_place_of_the_axis_is_not_asked(monkeypatch):
    monkeypatch.setattr(axis_by_fits.FitsByAxis, "misfits", lambda *_: pytest.fail("a fit was made"))
    answer = found(50.0, 0.7)
    assert answer.value == {} and "take the place of a move" in answer.why and not axis.is_known(answer)


def test_few_views_with_rays_tell_nothing():
    curve = Curve(lambda place: place**2)
    curve.views[:-20] = np.nan
    found = axis_by_fits._least(curve, 0.0, 0.05, 6.0)
    assert "too few views" in found.doubt and len(curve.asked) == 3

"""A bowtie out of what rays leave, by arrays alone."""

import math

import numpy as np
import pytest

from tomo_polysplat.nuisances.bowtie import Bowtie
from tomo_polysplat.nuisances.bowtie_estimate import filter_left
from tomo_polysplat.physics.filter_shape import filter_shapes

ROWS, COLUMNS, VIEWS = 3, 20, 30
SHAPES = filter_shapes(ROWS, COLUMNS, ("parabola", "slope"))
ANY = np.full(2, -math.inf)


def sums(coefficients, gains=0.0, uniform=0.0):
    """Sums over rays whose slopes differ from view to view, behind a filter, with gains of the pixels."""
    rng = np.random.default_rng(1)
    slopes, weight = -rng.uniform(0, 1, (VIEWS, ROWS, COLUMNS)), rng.uniform(0.5, 1, (VIEWS, ROWS, COLUMNS))
    left = slopes * (np.einsum("k,kij->ij", coefficients, SHAPES) + uniform)
    left = left + gains * rng.normal(size=(ROWS, COLUMNS))
    parts = np.stack([np.ones_like(left), slopes, slopes**2, left, slopes * left])
    return (parts * weight).sum(axis=1)


def test_it_is_found_whatever_the_gains_and_the_filter_of_all_pixels():
    found = filter_left(sums((0.7, -0.2), gains=0.1, uniform=0.3), SHAPES, ANY)
    np.testing.assert_allclose(found, (0.7, -0.2), atol=1e-9)


def test_a_step_stops_at_its_least():
    found = filter_left(sums((-0.7, 0.2)), SHAPES, np.array([-0.1, -math.inf]))
    assert found[0] == pytest.approx(-0.1) and found[1] == pytest.approx(0.2, abs=0.05)


def test_rays_that_meet_nothing_tell_nothing():
    nothing = np.zeros((5, ROWS, COLUMNS))
    nothing[0] = 1.0
    np.testing.assert_array_equal(filter_left(nothing, SHAPES, ANY), 0.0)


def test_it_is_kept_where_it_is_thick_and_not_contradicted():
    kept = {"thickest": 0.8, "better": 0.0, "better_error": 0.01}
    assert Bowtie.gate(kept).kept
    assert not Bowtie.gate(kept | {"thickest": 0.1}).kept
    assert not Bowtie.gate(kept | {"better": -0.2}).kept
    assert (
        not Bowtie.gate(kept | {"better": math.nan}).kept
        and not Bowtie.gate(kept | {"thickest": math.nan}).kept
    )
    assert Bowtie.told({"bowtie": {"parabola": 0.8}}) == "a bowtie of aluminium in cm, parabola 0.8"
    assert Bowtie.told({}) == "" and Bowtie.told({"bowtie": {}}) == ""

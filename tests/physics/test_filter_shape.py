"""Filters by a few numbers, and what they do to rays."""

import numpy as np
import pytest
import torch

import tomo_polysplat as tps
from tomo_polysplat.physics.filter_shape import bowtie_map, filter_shapes, filter_thickness
from tomo_polysplat.physics.filter_slope import filter_slope
from tomo_polysplat.physics.quadrature import fit_quadrature
from tomo_polysplat.physics.transmission import polychromatic_projection


def seen(areal, nodes, behind):
    return polychromatic_projection(areal, nodes, behind) - polychromatic_projection(0 * areal, nodes, behind)


def test_the_slope_is_that_of_what_is_measured_relative_to_the_open_beam():
    nodes = fit_quadrature(tps.Spectrum.from_tube(70, filters={"Al": 0.05}), nodes=5, behind=("Al", 0.0, 3.0))
    areal = torch.tensor(np.random.default_rng(0).uniform(0, 2, (3, 2, 4, 5)))
    areal[..., 0] = 0.0
    behind, step = torch.rand(4, 5, dtype=torch.float64), 1e-4
    slope = filter_slope(areal, nodes, behind)
    by_difference = (seen(areal, nodes, behind + step) - seen(areal, nodes, behind - step)) / (2 * step)
    torch.testing.assert_close(slope, by_difference, rtol=1e-4, atol=1e-8)
    assert (slope[..., 0].abs() < 1e-12).all(), "an empty ray tells nothing"
    assert (slope[..., 1:] < 0).all(), "what is hard already is hardened less"


def test_a_filter_has_nothing_where_it_is_thinnest():
    thickness = filter_thickness({"parabola": 2.0, "slope": 0.5}, 3, 40)
    assert thickness.min() == 0.0 and (thickness == thickness[:1]).all()
    u = filter_shapes(3, 40, ("slope",))[0]
    np.testing.assert_allclose(
        thickness - thickness[0, 20], 2 * u**2 + u / 2 - (2 * u**2 + u / 2)[0, 20], atol=1e-12
    )


def test_its_map_is_in_the_unit_of_the_scan():
    material, thickness, grams = bowtie_map({"parabola": 1.0}, 2, 9, "mm")
    assert material == "Al" and grams == pytest.approx(2.7, abs=0.01)
    np.testing.assert_allclose(thickness, 10 * filter_thickness({"parabola": 1.0}, 2, 9), rtol=1e-6)
    assert bowtie_map({}, 2, 9) is None

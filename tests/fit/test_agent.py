"""Contrast agents: edges inside a spectrum, and the levels that may tell agent from bone."""

import numpy as np
import pytest

from tomo_polysplat.fit.agent import levels_between
from tomo_polysplat.physics.edges import edge_inside
from tomo_polysplat.physics.spectrum import Spectrum


@pytest.mark.parametrize("material, edge", [("I", 33.17), ("BaSO4", 37.44), ("gadolinium", 50.24)])
def test_k_edges_of_contrast_agents_are_found_where_tables_have_them(material, edge):
    assert edge_inside(material, Spectrum.from_tube(90, filters={"Al": 0.1})) == pytest.approx(edge, abs=0.1)


@pytest.mark.parametrize("material", ["water", "bone", "aluminium", "titanium", "iron", "lead"])
def test_others_have_none_inside(material):
    assert edge_inside(material, Spectrum.from_tube(80, filters={"Al": 0.1})) is None


def test_an_edge_counts_only_inside_the_spectrum():
    assert edge_inside("I", Spectrum([40.0, 60.0, 80.0], [1.0, 1.0, 1.0])) is None
    assert edge_inside("I", Spectrum([60.0], [1.0])) is None


def test_levels_lie_between_pieces_the_widest_gaps_first():
    start = np.ones((1, 30, 30), np.float32)
    assert levels_between(start, 2.2) == []
    start[0, 2:5, 2:5] = 3.0
    assert levels_between(start, 2.2) == [2.2]
    start[0, 2:5, 12:15] = 5.0
    assert levels_between(start, 2.2) == pytest.approx([4.0])
    start[0, 20:25, 12:15], start[0, 20:25, 20:25] = 5.2, 9.2
    assert levels_between(start, 2.2) == pytest.approx([4.0, 7.2])

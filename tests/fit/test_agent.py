"""Contrast agents: edges inside a spectrum, and the levels that may tell agent from bone."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch
from small_scans import fan, geometries

from tomo_polysplat.fit.agent import levels_between, settings_for_agent
from tomo_polysplat.fit.first_volume import first_volume
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.physics.edges import edge_inside
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.settings import make_settings


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


@pytest.mark.parametrize("dense", ["I", "iron"])
def test_short_fits_begin_with_the_start_there_is_and_the_best_is_taken(dense, monkeypatch):
    """Without an edge in the spectrum none is made."""
    scan, device, seen = fan(), torch.device("cpu"), []

    def fit(problem, start, fitted, settings, *rest):
        seen.append((start, settings))
        return SimpleNamespace(held_out=1.0 / len(seen), cut=False)

    monkeypatch.setattr("tomo_polysplat.fit.agent.short_fit", fit)
    named = ("water", "bone", dense)
    problem = Problem.of(scan.projections.swapaxes(0, 1), *geometries(scan), "cm", scan.spectrum, named)
    start, _ = first_volume(problem, device, make_settings())
    settings = make_settings()
    options = {"seed": 0, "time_budget": None}
    best, told = settings_for_agent(start, 1.0, problem, settings, device, options)
    if dense == "iron":
        assert not seen and best is settings and not told
    else:
        assert len(seen) > 1 and all(one is start for one, _ in seen)
        assert (
            best.metal_level == seen[-1][1].metal_level != settings.metal_level and "agent" in told["agent"]
        )


def test_short_fits_that_the_time_budget_ends_tell_no_agent():
    scan, device = fan(), torch.device("cpu")
    named = ("water", "bone", "I")
    problem = Problem.of(scan.projections.swapaxes(0, 1), *geometries(scan), "cm", scan.spectrum, named)
    settings, options = make_settings(), {"seed": 0, "time_budget": 1e-3}
    start, _ = first_volume(problem, device, settings)
    best, told = settings_for_agent(start, 1.0, problem, settings, device, options)
    assert best is settings and "too short" in told["agent"]


def test_an_agent_too_weak_to_be_seen_is_told_of(caplog):
    scan, device = fan(), torch.device("cpu")
    named = ("water", "bone", "I")
    problem = Problem.of(scan.projections.swapaxes(0, 1), *geometries(scan), "cm", scan.spectrum, named)
    settings, options = make_settings(), {"seed": 0, "time_budget": None}
    start, _ = first_volume(problem, device, settings)
    weak = start.clamp(max=1.5 * problem.depth)
    best, told = settings_for_agent(weak, 1.0, problem, settings, device, options)
    assert best is settings and "not looked for" in told["agent"] and "bone_level" in caplog.text


def test_metal_that_was_named_starts_as_itself():
    scan, device, options = fan(), torch.device("cpu"), {"seed": 0, "time_budget": None}

    def start_of(dense, settings):
        named = ("water", "aluminium", dense)
        problem = Problem.of(scan.projections.swapaxes(0, 1), *geometries(scan), "cm", scan.spectrum, named)
        start, _ = first_volume(problem, device, make_settings())
        return settings_for_agent(start, 1.0, problem, settings, device, options)

    settings, told = start_of("titanium", make_settings())
    assert settings.metal_u == 1.0 and "named" in told["metal"]
    for dense, wanted in (("titanium", {"metal_u": 0.6}), ("Fe", {})):
        asked = make_settings(changes=wanted)
        assert start_of(dense, asked) == (asked, {})

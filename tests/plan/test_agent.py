"""Contrast agents: edges inside a spectrum, and the levels that may tell agent from bone."""

from types import SimpleNamespace

import numpy as np
import pytest
from planned import lab_of
from small_scans import fan, geometries

import tomo_polysplat as tps
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.physics.edges import edge_inside
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.plan import solver
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.plan.decisions.agent import Agent, levels_between
from tomo_polysplat.plan.order import answer_to
from tomo_polysplat.plan.preparation import fit_start


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


def lab(dense, budget=None, **settings):
    """A lab of a fan-beam scan whose dense material was named."""
    scan, named = fan(), ("water", "bone" if dense == "I" else "aluminium", dense)
    of = Problem.of(scan.projections.swapaxes(0, 1), *geometries(scan), "cm", scan.spectrum, named)
    made = lab_of(of, budget, **settings)
    made.short_fit = fit_start
    return made


def test_short_fits_begin_with_the_start_there_is_and_the_best_is_taken():
    seen, one = [], lab("I")

    def fit(of, settings, steps):
        seen.append((of.start, settings))
        return SimpleNamespace(held_out=1.0 / len(seen), cut=False)

    one.short_fit = fit
    answer = answer_to(Agent(), one)
    assert len(seen) > 1 and all(start is one.start for start, _ in seen)
    assert answer.value["metal_level"] == seen[-1][1].metal_level != one.settings.metal_level
    assert "agent" in answer.why


def test_short_fits_that_the_time_budget_ends_tell_no_agent():
    answer = answer_to(Agent(), lab("I", budget=1e-3))
    assert answer.value == {} and "too short" in answer.why


def test_an_agent_too_weak_to_be_seen_is_told_of(caplog):
    one = lab("I")
    one.start = one.start.clamp(max=1.5 * one.problem.depth)
    answer = answer_to(Agent(), one)
    assert answer.value == {} and "not looked for" in answer.why and "bone_level" in caplog.text


def test_metal_that_was_named_starts_as_itself():
    answer = answer_to(Agent(), lab("titanium"))
    assert answer.value == {"metal_u": 1.0} and "named" in answer.why
    for dense, wanted in (("titanium", {"metal_u": 0.6}), ("Fe", {})):
        assert answer_to(Agent(), lab(dense, **wanted)).value == {}


class Begun(Exception):
    pass


def test_the_run_takes_for_metal_what_the_seeds_did(monkeypatch):
    """Below the usual level of metal an agent is, to the run, soft matter with something dense in it."""
    scan, used = fan(), []

    def fit(setup, course):
        used.append(setup.settings)
        raise Begun

    monkeypatch.setattr(solver, "fit", fit)
    monkeypatch.setattr(Agent, "ask", lambda *asked: Answer.found({"metal_level": 3.5, "metal_u": 1.0}))
    told = {"passes": 1.0, "edges": "blurred", "growth": 1.0, "tv_factor": 1.0}
    with pytest.raises(Begun):
        tps.reconstruct(scan, materials=("water", "bone", "I"), settings=told, progress=False, device="cpu")
    assert used[0].metal_level == 3.5 and used[0].metal_u == 1.0

"""A detector that is rolled, and views that wobble, are found by default; a scanner that is right stays as it is."""

from functools import cache

import numpy as np
import pytest
import torch

import tomo_polysplat as tps
from tomo_polysplat.fit.move_sums import MoveSums
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.nuisances.move_estimate import WholeMoves
from tomo_polysplat.plan import realignment
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.first_look import first_look
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.preparation import lab_of
from tomo_polysplat.ranks import Ranks, current_ranks, led_by
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.moves import Scanner, moved_geometry
from tomo_polysplat.settings import make_settings

AXIS = Answer({}, "the axis of rotation is where it was told", Status.ASKED, {"offset": 0.0, "error": 0.005})
VIEWS = 48
OPTIONS = FitOptions(make_settings("balanced", None), None, 0, torch.device("cpu"))


@cache
def wobble():
    shifts = np.random.default_rng(4).normal(0, 0.6, (VIEWS, 2))
    return shifts - shifts.mean(axis=0)


@cache
def problem(moved):
    """Told by a geometry that lacks what the scanner did: it is told moved the other way, to first order."""
    scan = tps.simulate_scan("teeth", 20, VIEWS, photons=1e5)
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    moves = {"roll": torch.tensor(-1.5).double(), "views": torch.from_numpy(-wobble())} if moved else {}
    told = moved_geometry(Scanner(geometry), moves) if moved else geometry
    values = np.ascontiguousarray(scan.projections.transpose(1, 0, 2))
    return Problem.of(values, told, grid, scan.unit, scan.spectrum, None)


@cache
def first(moved):
    return first_look(lab_of(problem(moved), Plan(), OPTIONS), 1.0)


def ask(moved, axis=AXIS):
    return realignment.realigned(problem(moved), axis, first(moved), OPTIONS, lambda *_: None)


def test_a_scanner_that_is_right_is_left():
    assert ask(False) is AXIS


def test_roll_and_shifts_of_views_are_found():
    found, true = ask(True), problem(True)
    assert found.value["roll"] == pytest.approx(1.5, abs=0.15)
    # But for what would move the object.
    order = np.arange(VIEWS) if true.order is None else np.argsort(true.order)
    shifts = np.array(found.value["views"])[order]
    assert np.std(shifts[:, 1] - wobble()[:, 1]) < 0.15 and np.std(shifts[:, 0] - wobble()[:, 0]) < 0.3
    assert found.evidence["better"] > 0.2 and "falls" in found.why


def test_joined_pixels_tell_moves_in_pixels_of_the_detector(monkeypatch):
    """Half as many columns: what is found is as large as by all of them, within what a coarser fit tells."""
    monkeypatch.setattr(realignment, "_COLUMNS", problem(True).geometry.columns // 2)
    joined, pixel = realignment._joined(problem(True))
    assert joined.geometry.columns == problem(True).geometry.columns // 2 and pixel.tolist() == [2, 2]
    found, true = ask(True), problem(True)
    assert found.value["roll"] == pytest.approx(1.5, abs=0.3)
    order = np.arange(VIEWS) if true.order is None else np.argsort(true.order)
    shifts = np.array(found.value["views"])[order]
    assert np.std(shifts[:, 1] - wobble()[:, 1]) < 0.3 and np.std(shifts[:, 0] - wobble()[:, 0]) < 0.4


@pytest.mark.parametrize("columns, together", [(1000, 2), (1, 1)])
def test_a_small_detector_of_joined_pixels_waits_for_no_other_process(columns, together, monkeypatch):
    seen = []
    monkeypatch.setattr(realignment, "_COLUMNS", columns)
    monkeypatch.setattr(realignment._Realignment, "is_clear", lambda *_: True)
    monkeypatch.setattr(
        realignment._Realignment, "_fitted", lambda *_: seen.append(current_ranks().count) or 1 / 0
    )
    with led_by(Ranks(0, 2)), pytest.raises(ZeroDivisionError):
        ask(False)
    assert seen == [together]


@pytest.mark.parametrize(
    "before, after",
    [([1.0, 1.2, 0.9], [0.995, 1.194, 0.896]), ([1.0, 1.2, 0.9], [1.6, 0.5, 0.6]), ([np.nan] * 3, [1.0] * 3)],
)
def test_moves_that_held_out_rays_do_not_confirm_are_not_made(monkeypatch, before, after):
    found = {"roll": torch.tensor(1.0).double()}, [np.array(before), np.array(after)]
    monkeypatch.setattr(realignment._Realignment, "is_clear", lambda *_: True)
    monkeypatch.setattr(realignment._Realignment, "moved", lambda *_: found)
    assert ask(False) is AXIS


def test_a_fit_that_fails_moves_nothing_and_ends_no_run(monkeypatch, caplog):
    def failing(*_, **__):
        raise RuntimeError("broken")

    monkeypatch.setattr(realignment, "lab_of", failing)
    assert ask(True) is AXIS and "broken" in caplog.text
    monkeypatch.setattr(Lab, "trial", failing)
    assert (
        first_look(lab_of(problem(False), Plan(), OPTIONS), 1.0) is None and caplog.text.count("broken") == 2
    )


def test_a_short_run_is_not_asked():
    """A pass would be more than the share of it that may be taken."""
    quick = FitOptions(make_settings("balanced", {"passes": 9.0}), None, 0, torch.device("cpu"))
    assert first_look(lab_of(problem(False), Plan(), quick), 0.1) is None
    assert realignment.realigned(problem(False), AXIS, None, quick, lambda *_: None) is AXIS


def test_a_roll_that_hides_from_a_fit_is_reached_by_longer_steps():
    left, before, step = np.array([0.2, 0.3, -0.1]), np.array([0.4, 0.0, 0.2]), np.array([0.4, 0.0, 0.2])
    np.testing.assert_allclose(realignment._secant(left, before, step), [0.4, 0.3, -0.1])


@pytest.mark.parametrize(("first_told", "roll"), [(1.0, 0.9), (0.15, 0.0)])
def test_what_is_left_of_a_roll_that_was_made_needs_not_be_sure(first_told, roll, monkeypatch):
    """Two standard errors tell that there is one. How large it is, is told best by where no more is left."""
    told = iter([first_told, -0.1, 0.0])
    many = np.zeros((2, VIEWS, 4, 4))
    sums = MoveSums(many, many[..., 0], np.ones(VIEWS), rows=1.0)
    monkeypatch.setattr(realignment, "move_sums", lambda *_: sums)
    monkeypatch.setattr(realignment, "falls_of", lambda *_: None)
    monkeypatch.setattr(
        realignment, "whole_moves", lambda *_: WholeMoves(np.array([next(told)]), np.array([0.08]))
    )
    fits = realignment._Realignment(problem(False), AXIS, OPTIONS)
    fits._fitted = lambda values: (None, None, None)
    assert fits.names == ("roll",)
    assert float(fits.moved({})[0].get("roll", 0.0)) == pytest.approx(roll)


def test_a_fit_by_a_rolled_scanner_does_not_warn_of_matter_beside_a_few_rows(caplog):
    """A part of each row of such a detector passes above two slices, or below, where the object goes on."""
    degrees = np.linspace(0, 180, VIEWS, endpoint=False)
    told = from_astra(*tps.parallel_geometry(pixel=0.1, detector=(2, 30), degrees=degrees))
    across = np.abs(np.arange(30) - 14.5)
    values = np.broadcast_to(0.2 * np.sqrt(np.maximum(11.0**2 - across**2, 0)), (VIEWS, 2, 30)).astype(
        np.float32
    )
    told = Problem.of(np.ascontiguousarray(values), *told, "cm", None, None)
    rolled = {"roll": torch.tensor(20.0).double()}
    told.seen_by(moved_geometry(Scanner(told.geometry, told.axis), rolled)).closed(OPTIONS.device)
    assert "reaches beyond the volume" in caplog.text
    caplog.clear()
    realignment._Realignment(told, AXIS, OPTIONS)._fitted(rolled)
    assert "reaches beyond" not in caplog.text


def test_rows_that_are_alike_tell_no_roll_and_no_shifts_along_columns():
    """Rods through all of three rows, and views that wobble across them: rows differ by noise, which tells no move."""
    rng, degrees = np.random.default_rng(2), np.linspace(0, 180, 60, endpoint=False)
    wobbled, turned = rng.normal(0, 0.5, 60), np.deg2rad(degrees)
    across = (np.arange(41) - 20 + wobbled[:, None]) * 0.1
    values = np.zeros((60, 41))
    for x, y, radius, density in ((0.1, 0.0, 1.6, 0.2), (0.7, -0.4, 0.4, 3.0), (-0.5, 0.6, 0.3, -0.2)):
        away = across - (x * np.cos(turned) + y * np.sin(turned))[:, None]
        values += 2 * density * np.sqrt(np.maximum(radius**2 - away**2, 0))
    rows = values[:, None] + rng.normal(0, 0.003, (60, 3, 41)) * np.exp(0.5 * values)[:, None]
    told = from_astra(*tps.parallel_geometry(pixel=0.1, detector=(3, 41), degrees=degrees))
    told = Problem.of(rows.astype(np.float32), *told, "cm", None, None)
    moved, misfits = realignment._Realignment(told, AXIS, OPTIONS).moved({})
    order = np.arange(60) if told.order is None else told.order
    shifts = moved["views"].numpy()
    assert list(moved) == ["views"] and np.abs(shifts[:, 1]).max() < 1e-9
    assert np.corrcoef(shifts[:, 0], wobbled[order])[0, 1] ** 2 > 0.9
    assert np.nanmean(misfits[-1]) < 0.7 * np.nanmean(misfits[0])

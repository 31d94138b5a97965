"""A scanner that stood elsewhere than told: the moves are found, made, and kept for others to use."""

import json
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

import tomo_polysplat as tps
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan import axis
from tomo_polysplat.plan.alignment import moves_of
from tomo_polysplat.plan.coarse import joined_pixels
from tomo_polysplat.plan.fit_options import FitOptions
from tomo_polysplat.report.decided import doubts
from tomo_polysplat.scan.axis_offset import AxisOffset
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.layout import vector_form
from tomo_polysplat.settings import make_settings

QUICK = {"passes": 5.0, "views_per_step": 8, "pixel_rays": 1, "gains": False, "drift": False}


@cache
def fan(metal=True):
    return tps.simulate_scan("pins", size=32, views=51, geometry="fan", metal=metal)


def off(scan, columns):
    """The told geometry of a scanner whose detector stood so many columns to the right."""
    told = dict(vector_form(scan.proj_geom))
    vectors = np.array(told["Vectors"])
    steps = vectors[:, 4:6] if told["type"] == "fanflat_vec" else vectors[:, 6:9]
    place = slice(2, 4) if told["type"] == "fanflat_vec" else slice(3, 6)
    vectors[:, place] -= columns * steps
    return told | {"Vectors": vectors}


def reconstruct(scan, geometry, **options):
    usual = {"unit": scan.unit, "spectrum": scan.spectrum, "settings": QUICK, "progress": False}
    # What the scanner did to the light is asked in other files.
    options = usual | {"calibrate": False} | options
    return tps.reconstruct(scan.projections, geometry, scan.vol_geom, **options)


def error(result, scan):
    return float(np.sqrt(np.mean((result.volume - scan.truth) ** 2)))


def test_an_axis_that_is_off_is_found_and_used():
    scan, told = fan(), off(fan(), 1.5)
    found, as_told, right = (
        reconstruct(scan, told, align="u"),
        reconstruct(scan, told, align=False),
        reconstruct(scan, scan.proj_geom, align=False),
    )
    assert found.plan["alignment"].value["u"] == pytest.approx(1.5, abs=0.05)
    assert error(found, scan) < 1.1 * error(right, scan) < 0.5 * error(as_told, scan)
    # By default, in a moment, and beside a time budget as well.
    for options in ({}, {"time_budget": 60.0}):
        mended = reconstruct(scan, told, **options)
        assert mended.plan["alignment"].value["u"] == pytest.approx(1.5, abs=0.02)
        assert error(mended, scan) < 1.1 * error(right, scan)
    assert "alignment" not in as_told.plan


@pytest.mark.parametrize("align", ["auto", ("u",)])
def test_what_no_ray_confirms_is_not_moved(align):
    scan = fan(metal=False)
    settings = QUICK | {"passes": 1.0}  # the two are to be the same to the bit, whatever they come to
    asked, plain = (reconstruct(scan, scan.proj_geom, align=one, settings=settings) for one in (align, False))
    assert asked.plan["alignment"].value == {}
    assert ("no move" if align != "auto" else "where it was told") in asked.plan["alignment"].why
    assert np.array_equal(asked.volume, plain.volume)
    np.testing.assert_array_equal(asked.geometry["Vectors"], plain.geometry["Vectors"])
    others = [
        {k: v for k, v in r.plan.items() if k not in ("alignment", "compiling")} for r in (asked, plain)
    ]
    assert others[0] == others[1]


def problem_off(columns):
    projections = np.ascontiguousarray(fan().projections.transpose(1, 0, 2))
    problem = Problem.of(projections, *from_astra(off(fan(), columns), fan().vol_geom), "cm", None, None)
    return problem, FitOptions(make_settings("balanced", None), None, 0, torch.device("cpu")), lambda *_: None


def test_a_move_that_held_out_rays_do_not_confirm_is_not_made(monkeypatch):
    monkeypatch.setattr(axis.FitsByAxis, "misfits", lambda *_: np.ones(51))
    answer = axis.find_axis(*problem_off(1.5))
    assert answer.value == {} and "do not confirm" in answer.why and answer.evidence["offset"] > 1


@pytest.mark.parametrize(
    "owner, part, words",
    [
        (axis, "offset_of", "comparing them failed"),
        (axis.FitsByAxis, "misfits", "not be asked"),
        (axis, "axis_by_fits", "do not tell"),
    ],
)
def test_a_probe_that_fails_moves_nothing_and_ends_no_run(monkeypatch, caplog, owner, part, words):
    def failing(*_):
        raise RuntimeError("broken")

    if part != "misfits":  # fits are asked where opposite rays do not tell
        monkeypatch.setattr(axis, "offset_of", lambda _: AxisOffset(0.0, np.inf, "comparing them failed"))
        monkeypatch.setattr(axis, "axis_by_fits", failing)
    monkeypatch.setattr(owner, part, failing)
    answer = axis.find_axis(*problem_off(1.5))
    assert answer.value == {} and words in answer.why and not axis.is_known(answer)
    assert "broken" in caplog.text


def test_angles_that_run_backwards_are_said(caplog):
    """Opposite rays of a fan agree one way round only; of a scan that is right nothing is said."""
    scan = tps.simulate_scan("lung", size=24, views=60, geometry="fan")
    _, *rest = problem_off(0.0)
    for order, said in ((slice(None), False), (slice(None, None, -1), True)):
        caplog.clear()
        projections = np.ascontiguousarray(scan.projections.transpose(1, 0, 2)[order])
        geometry = from_astra(scan.proj_geom, scan.vol_geom)
        answer = axis.find_axis(Problem.of(projections, *geometry, "cm", None, None), *rest)
        assert answer.value == {} and ("angles times -1" in caplog.text) is said
        assert any("angles times -1" in doubt for doubt in doubts({"alignment": answer})) is said


def test_a_user_who_interrupts_the_probe_is_heard(monkeypatch):
    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(axis, "offset_of", interrupted)
    with pytest.raises(KeyboardInterrupt):
        axis.find_axis(*problem_off(0.0))


def test_fits_that_confirm_nothing_leave_no_trace_in_the_result(monkeypatch):
    fits, scan = axis.FitsByAxis.misfits, fan()
    told = off(scan, 0.5)
    plain = reconstruct(scan, told, align=False, settings=QUICK | {"passes": 1.0})
    monkeypatch.setattr(axis.FitsByAxis, "misfits", lambda *asked: 0.0 * fits(*asked))
    asked = reconstruct(scan, told, settings=QUICK | {"passes": 1.0})
    assert "do not confirm" in asked.plan["alignment"].why
    assert np.array_equal(asked.volume, plain.volume)
    np.testing.assert_array_equal(asked.geometry["Vectors"], plain.geometry["Vectors"])


def test_who_leaves_the_axis_where_the_file_has_it_leaves_it_from_auto_too():
    scan = replace(fan(), proj_geom=off(fan(), 0.4))
    result = tps.reconstruct(scan, mend=False, settings=QUICK | {"passes": 1.0}, progress=False)
    assert "alignment" not in result.plan and "mended" not in result.plan


def test_the_geometry_that_was_found_is_in_the_file(tmp_path):
    result = reconstruct(fan(), fan().proj_geom, settings=QUICK | {"passes": 1.0})
    result.save(tmp_path / "a.h5")
    stored = tps.Result.load(tmp_path / "a.h5").geometry
    np.testing.assert_array_equal(stored["Vectors"], result.geometry["Vectors"])
    assert stored["type"] == result.geometry["type"]


class Stopped(Exception):
    pass


def test_an_interrupted_run_goes_on_by_the_scanner_that_was_found(tmp_path):
    scan, path, seen = fan(), tmp_path / "fit.npz", []

    def stop(state):
        seen.append(state)
        if len(seen) > 2:
            raise Stopped

    told = off(scan, 1.5)
    with pytest.raises(Stopped):
        reconstruct(scan, told, align="u", checkpoint=path, callbacks=[stop])
    with np.load(path) as file:
        arrays = dict(file)
    rest = reconstruct(scan, told, align="u", checkpoint=path, resume=True)
    assert rest.plan["alignment"].value["u"] == pytest.approx(1.5, abs=0.05)
    assert error(rest, scan) < 0.5 * error(reconstruct(scan, told, align=False), scan)
    about = json.loads(arrays["about"].tobytes())
    for wrong in ({"sideways": 1.0}, {"u": "much"}, {"u": float("nan")}, None):
        about["plan"]["facts"]["alignment"]["value"] = wrong
        text = np.frombuffer(json.dumps(about).encode(), np.uint8)
        np.savez(path, **(arrays | {"about": text}))
        with pytest.raises(ValueError, match="checkpoint: expected a complete checkpoint"):
            reconstruct(scan, told, align="u", checkpoint=path, resume=True)


@pytest.mark.parametrize(
    "wanted, budget, word",
    [
        (True, 3.0, "time_budget"),
        ("sideways", None, "one of"),
        (["auto", "u"], None, "alone"),
        (3, None, "names"),
        (["u", "w"], None, "one of"),
    ],
)
def test_what_makes_no_sense_is_refused(wanted, budget, word):
    with pytest.raises((ValueError, TypeError), match=f"align: .*{word}"):
        moves_of(wanted, budget)


def test_joined_pixels_are_means_of_those_that_count():
    values = np.arange(2 * 3 * 5, dtype=np.float32).reshape(2, 3, 5)
    values[0, 0, 0] = np.nan
    found = torch.from_numpy(joined_pixels(values, 1, 2))
    assert found.shape == (2, 3, 2) and found[0, 0, 0] == 1.0
    torch.testing.assert_close(found[1], torch.tensor([[15.5, 17.5], [20.5, 22.5], [25.5, 27.5]]))
    assert joined_pixels(values, 1, 1) is values

"""What is decided from the data, in any unit."""

import json
import logging
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from docs_examples import DOCS
from planned import ball, plan, problem, why

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.plan import first_volume as first_volumes
from tomo_polysplat.plan.answer import Status
from tomo_polysplat.plan.decision import Known
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.model import all_curves, scene_of
from tomo_polysplat.plan.order import ORDER, plan_from_start
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.usable import usable_rays
from tomo_polysplat.settings import Settings
from tomo_polysplat.simulate.scenes import simulate_scan

WATER = 0.2  # 1/cm, for monochromatic problems


@pytest.mark.parametrize("density", [0.015, 0.05, 0.3, 1.0, 2.0, 20.0, 280.0])
def test_no_matter_from_foam_to_gold_changes_the_unit_and_foam_is_named(density, caplog):
    of = problem(polychromatic=True)
    with caplog.at_level(logging.WARNING):
        assert plan(of, ball(of, density)).reference == pytest.approx(1.0 if density < 3 else density)
    assert ("as foam does" in caplog.text) == bool(caplog.text) == (density < 0.3)


@pytest.mark.parametrize("wrong", [1e-6, 1e-3, 1e3, 1e6])
@pytest.mark.parametrize("density", [0.7, 1.0, 8.9])
def test_lengths_off_by_a_power_of_a_thousand_change_the_reference_alike(wrong, density, caplog):
    of = problem(polychromatic=True, factor=1 / wrong)
    with caplog.at_level(logging.WARNING):
        found = plan(of, ball(of, density * wrong), density_check="warn")
    assert found.reference == pytest.approx(wrong, rel=1e-12) and "unit of length" in caplog.text


def test_a_monochromatic_reference_is_the_object_itself():
    for factor in (1e-3, 1.0, 1e3):
        of = problem(factor=factor)
        assert plan(of, ball(of, WATER / factor)).reference == pytest.approx(WATER / factor, rel=1e-6)


def test_a_monochromatic_reference_is_that_of_walls_too_thin_to_show_it_and_not_of_metal():
    of = problem()
    start = ball(of, WATER)
    thin, metal = start.copy(), start.copy()
    thin[::2] *= 0.5
    metal[6, 6, :] = 30 * WATER * of.depth
    share = metal[6, 6].sum() / metal.sum()
    assert 0.3 < share < 0.5
    for volume in (thin, metal):
        assert plan(of, volume).reference == pytest.approx(WATER, rel=1e-6)


@pytest.mark.parametrize("factor", [10.0, 1e-3, 1 / 3, 1e4])
def test_the_solver_sees_the_same_scan_in_any_unit(factor):
    one, other = problem(), problem(factor=factor)
    for name in ("origin", "corner", "u", "v"):
        assert np.array_equal(getattr(one.geometry, name), getattr(other.geometry, name)), name
    assert np.array_equal(one.grid.lower, other.grid.lower)
    assert other.length == pytest.approx(factor * one.length) == pytest.approx(other.depth)


def test_depth_is_in_centimetres_where_attenuation_is_tabulated_in_them():
    assert problem(unit="mm", polychromatic=True).depth == pytest.approx(0.1)
    assert problem(unit="mm").depth == pytest.approx(1.0)


def test_one_row_and_one_slice_in_one_plane_are_planar():
    assert problem(planar=True).planar and not problem().planar
    assert not problem(planar=True, height=1.0).planar, "the rays pass beside the slice"


def test_what_is_asked_for_is_taken_as_it_is():
    of = problem(planar=True)
    chosen = plan(of, ball(of, 1), seed_spacing=3.0, views_per_step=7)
    assert (chosen.spacing, chosen.views_per_step) == (3.0, 7)
    given = [name for name, answer in chosen.answers.items() if answer.status is Status.GIVEN]
    assert given == ["seed_spacing", "views_per_step"]


@pytest.mark.parametrize("polychromatic", [False, True])
def test_every_decision_has_a_reason(polychromatic):
    of = problem(planar=True, polychromatic=polychromatic)
    answers = plan(of, ball(of, 1)).answers
    assert {"curves", "support_level", "seed_spacing", "views_per_step", "passes"} <= answers.keys()
    for name, answer in answers.items():
        assert answer.why, name


def test_dense_matter_that_only_the_fit_shows_is_told(caplog):
    of = problem(polychromatic=True)
    chosen = plan(of, ball(of, 1))
    basis = np.ones((1, 2, 2, 2), np.float32)
    caplog.set_level(logging.INFO)
    assert all_curves(of, basis, chosen, 2.2, 6.0).shape == (3, 2, 2, 2) and not caplog.records
    assert not all_curves(of, basis, chosen, 2.2, 6.0)[1:].any()
    # Thin bone is no worse as dense soft matter; metal is.
    for times, level in ((3, logging.INFO), (7, logging.WARNING)):
        all_curves(of, times * basis, chosen, 2.2, 6.0)
        assert caplog.records[-1].levelno == level
        assert f"{times} soft references" in caplog.text and f"{times} soft" in why(chosen, "dense_matter")


def test_an_empty_start_can_be_planned():
    for polychromatic in (False, True):
        of = problem(polychromatic=polychromatic)
        chosen = plan(of, np.zeros(of.grid.shape, np.float32))
        assert chosen.reference == 1.0 and chosen.spacing > 0


def test_the_larger_a_volume_the_less_often_it_is_smoothed():
    """As often as steps have time for, but neither at every step of a volume nor by leaps."""

    def every(size, device, planar=False):
        of = problem(size, planar=planar)
        return plan(of, ball(of, WATER), device=device).tv_every

    assert [every(size, "cpu") for size in (12, 50, 70, 105)] == [2, 2, 3, 4]
    assert [every(size, "cuda") for size in (12, 105)] == [2, 2]
    assert [every(size, "cpu", planar=True) for size in (12, 300, 500, 900)] == [1, 1, 2, 4]
    assert [every(size, "cuda", planar=True) for size in (12, 900)] == [1, 1]


@pytest.mark.parametrize("passes", [1.0, 60.0, 90.0, 10_000.0])
def test_views_of_a_step_leave_enough_steps(passes):
    """More in a longer run, and larger ones, by the root of its passes alike."""
    of = problem()
    made = plan(of, ball(of, WATER), passes=passes)
    views, steps = made.views_per_step, passes * of.geometry.views / made.views_per_step
    assert views == {1.0: 1, 10_000.0: 12}.get(passes, views)
    assert "of 20" in why(made, "views_per_step")
    assert steps == pytest.approx(93 * passes**0.5, rel=0.35) or views in (1, 12)


@pytest.mark.parametrize(
    ("size", "views", "planar", "passes", "together"),
    [
        (12, 150, False, 20.0, 4),
        (49, 150, False, 15.0, 6),
        (49, 30, False, 22.5, 2),
        (49, 8, False, 45.0, 1),
        (30, 150, True, 20.0, 5),
        (400, 150, True, 10.0, 5),
        (30, 30, True, 30.0, 3),
    ],
)
def test_a_run_is_longer_for_a_small_cloud_and_for_few_views(size, views, planar, passes, together):
    """For a small cloud in steps and in passes, of which volumes gain fewer; of few views in passes, thrice at most."""
    of = problem(size, views=views, planar=planar)
    made = plan(of, ball(of, WATER))
    assert (made.passes, made.views_per_step) == (passes, together)


@pytest.mark.parametrize("planar", [True, False])
def test_a_run_of_a_length_that_was_asked_for_is_no_longer_for_a_small_cloud(planar):
    of = problem(30 if planar else 12, views=150, planar=planar)
    made = plan(of, ball(of, WATER), passes=10.0)
    assert (made.passes, made.views_per_step) == (10.0, 5)


@pytest.mark.parametrize(("density", "curves"), [(1.0, 1), (2.0, 1), (2.5, 3)])
def test_three_curves_are_for_dense_matter(density, curves):
    of = problem(polychromatic=True)
    start = ball(of, 1)
    start[4, 5, 6] = density * of.depth
    chosen = plan(of, start)
    assert chosen.curves == curves
    assert ("denser" in why(chosen, "curves")) == (curves == 3)


def test_curves_can_be_asked_for():
    of = problem(polychromatic=True)
    assert plan(of, ball(of, 1), curves=3).curves == 3
    assert plan(of, ball(of, 8), curves=1).curves == 1
    assert plan(of, ball(of, 1), soft_u=0.1).curves == 3, "no curve is the soft matter's"
    assert plan(problem(), ball(of, 8), curves=3).curves == 1, "one energy has one curve"


@pytest.mark.parametrize("wrong", [{"curves": 2}, {"curves": 4}, {"curves": 1, "soft_u": 0.1}])
def test_curves_that_make_no_sense_are_refused(wrong):
    with pytest.raises(ValueError, match="curves"):
        Settings(**wrong)


def test_no_hardening_leaves_one_energy():
    """Thin rays tell nothing of the spectrum: one node, and a line integral as of a monochromatic scan."""
    of, settings = problem(polychromatic=True), Settings()
    for largest, nodes in ((1e-3, 1), (3.0, 2)):
        thin = replace(of, projections=of.projections * np.float32(largest))
        device = torch.device("cpu")
        chosen = plan_from_start(torch.as_tensor(ball(of, 1)), thin, settings, device)
        scene = scene_of(thin, chosen, settings, device)
        assert (scene.quadrature is None) == (nodes == 1)
        assert ("one energy" in why(chosen, "hardening")) == (nodes == 1)


@pytest.mark.parametrize(("views", "photons"), [(44, 1e5), (44, 300.0), (9, 1e4)])
def test_metal_is_seen_in_a_start_and_noise_is_not_taken_for_it(views, photons):
    for metal, curves in ((True, 3), (False, 1)):
        scan = simulate_scan("pins", 20, views, metal=metal, photons=photons)
        values, _, _ = usable_rays(scan.projections, scan.proj_geom, scan.valid)
        of = Problem.of(values, *from_astra(scan.proj_geom, scan.vol_geom), "cm", scan.spectrum, None)
        start, _ = first_volume(of, torch.device("cpu"), Settings())
        assert plan(of, start).curves == curves, (metal, why(plan(of, start), "curves"))


@pytest.mark.parametrize(("times", "solid"), [(1, False), (4, True)])
def test_the_first_volume_is_the_same_where_the_rays_are_made_anew_to_bridge_metal(times, solid, monkeypatch):
    """As a GPU does; four times as dense the object is looked at as one solid, and its metal is bridged."""
    scan = simulate_scan("pins", 20, 60)
    values, _, _ = usable_rays(scan.projections * np.float32(times), scan.proj_geom, scan.valid)
    of = Problem.of(values, *from_astra(scan.proj_geom, scan.vol_geom), "cm", scan.spectrum, None)
    kept, words = first_volume(of, torch.device("cpu"), Settings())
    assert (of.solid, "metal bridged, which" in words) == (solid, solid)
    made = first_volumes._of_one_material
    monkeypatch.setattr(first_volumes, "_of_one_material", lambda *scan: (*made(*scan)[:2], None))
    anew, _ = first_volume(of, torch.device("cpu"), Settings())
    assert torch.equal(anew, kept)


def test_a_corner_that_is_asked_for_is_taken():
    of = problem(polychromatic=True)
    assert plan(of, ball(of, WATER), tv_corner=0.3).tv_corners == (0.3, 0.3)


def test_the_order_keeps_what_each_decision_needs():
    """Who reads an answer stands behind it, and each has a name, a setting or the data, and a page of its own."""
    for place, kind in enumerate(ORDER):
        assert set(kind.needs) <= set(ORDER[:place]), kind
    names = [kind.name for kind in ORDER]
    assert len(set(names)) == len(names) and all(names)


def test_a_decision_has_one_name_for_its_file_its_page_and_its_setting():
    """But for those that no setting of their own answers, which the docs name."""
    without = {"soft_reference", "optical_depth", "detector_blur", "scatter"}
    way = (DOCS / "way.md").read_text(encoding="utf-8")
    for kind in ORDER:
        assert kind.__module__ == f"tomo_polysplat.plan.decisions.{kind.name}"
        assert (DOCS / "decisions" / f"{kind.name}.md").exists(), kind
        assert hasattr(Settings(), kind.name) == (kind.name not in without), kind
    assert all(f"`{name}`" in way for name in without)


def test_an_answer_that_a_decision_does_not_name_cannot_be_read():
    of = problem()
    chosen = plan(of, ball(of, WATER))
    one, other = ORDER[0], ORDER[5]
    assert one not in ORDER[7].needs
    with pytest.raises(LookupError, match=one.__name__):
        Known(chosen, ORDER[7])[one]
    assert other.name in chosen.answers


def test_a_plan_comes_back_from_json():
    of = problem(polychromatic=True)
    chosen = plan(of, ball(of, 1), views_per_step=3)
    again = Plan.from_dict(json.loads(json.dumps(chosen.to_dict())))
    assert again == chosen
    for kind in ORDER:
        if kind.name in again.answers:
            assert kind().valid(again.answers[kind.name].value), kind
            assert not kind().valid(math.nan) and not kind().valid("many"), kind

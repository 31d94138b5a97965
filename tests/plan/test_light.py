"""Whether light matter is fat: who wins, that the loser leaves no trace, and when nobody asks."""

from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from killed_runs import assert_same, resumed_after
from planned import planned, told_beforehand

import tomo_polysplat as tps
from tomo_polysplat.fit.optimise import Run
from tomo_polysplat.fit.stopping import Clock
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.plan.answer import Status
from tomo_polysplat.plan.decisions import light
from tomo_polysplat.plan.decisions.light import Light
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.order import ask_between
from tomo_polysplat.settings import Settings
from tomo_polysplat.simulate.scanner import Scanner
from tomo_polysplat.simulate.scenes import scan_phantom, scene_phantom

QUICK = {
    "passes": 10.0,
    "views_per_step": 11,
    "edges": "blurred",
    "tv_factor": 1.0,
    "pixel_rays": 1,
    "soft_gain": 0.0,
    "gains": False,
    "drift": False,
}
VIEWS = 41
# For what is told whatever the volume comes to.
FEW_STEPS = {"views_per_step": VIEWS}


@pytest.fixture(scope="module")
def pancreas():
    return tps.simulate_scan("pancreas", size=15, views=VIEWS)


@pytest.fixture
def small(monkeypatch):
    """Small volumes are asked about."""
    monkeypatch.setattr(light, "_FEWEST_VOXELS", 10)


def answer_with(monkeypatch, gain):
    """The misfits of the views are such that those as fat are less by so much, and by another little each."""

    def misfits(fitters):
        was = np.linspace(1.0, 1.1, VIEWS)
        return [was, was * (1 - gain) + 0.01 * np.sin(np.arange(VIEWS))]

    monkeypatch.setattr(light, "_misfits", misfits)


def reconstruct(scan, settings=None, **options):
    # Where the scanner stood, and what it did to the light, is asked in other files.
    usual = {"unit": scan.unit, "spectrum": scan.spectrum, "progress": False, "align": False}
    options = usual | {"calibrate": False} | options
    settings = QUICK | (settings or {})
    return tps.reconstruct(scan.projections, scan.proj_geom, scan.vol_geom, settings=settings, **options)


@pytest.fixture(scope="module")
def as_soft(pancreas):
    return reconstruct(pancreas, {"light": "soft"})


@pytest.fixture(scope="module")
def found_fat(pancreas):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(light, "_FEWEST_VOXELS", 10)
        answer_with(patch, 0.01)
        return reconstruct(pancreas)


def abdomen(fat):
    """A pancreas with this for fat, of fat's attenuation at the effective energy."""
    usual = tps.simulate_scan("pancreas", size=96, views=180)
    phantom = scene_phantom("pancreas")
    like = np.divide(*(mass_attenuation(name, [usual.truth_energy_kev])[0] for name in ("adipose", fat)))
    parts = [
        replace(part, material=fat, density=part.density * like) if part.material == "adipose" else part
        for part in phantom.parts
    ]
    scanner = Scanner(1e5, 3.0, 0.0, True, 0)
    return scan_phantom(
        replace(phantom, parts=tuple(parts)), usual.proj_geom, usual.vol_geom, usual.spectrum, scanner
    )


@pytest.mark.gpu
@pytest.mark.parametrize(("fat", "told"), [("adipose", "fat"), ("water", "soft")])
def test_rays_tell_fat_from_thin_water(fat, told):
    """Of a volume as large as that a CPU would take minutes for it."""
    scan = abdomen(fat)
    result = tps.reconstruct(
        scan.projections, scan.proj_geom, scan.vol_geom, unit="cm", spectrum=scan.spectrum, device="cuda"
    )
    assert result.plan["light"].value == told


def test_the_loser_leaves_no_trace_of_itself(pancreas, as_soft, small, monkeypatch):
    answer_with(monkeypatch, -0.01)
    told, wanted = reconstruct(pancreas), as_soft
    assert told.plan["light"].value == "soft" and told.plan["light"].why.startswith("as fat it leaves +")
    assert wanted.plan["light"].status is Status.GIVEN
    assert told.plan["alternatives"].value["light"].startswith("soft or fat: ")
    assert "light" not in wanted.plan["alternatives"].value
    assert np.array_equal(told.volume, wanted.volume)


def test_fat_goes_on_as_fat(pancreas, as_soft, found_fat):
    told, soft, wanted = found_fat, as_soft, reconstruct(pancreas, {"light": "fat"})
    assert told.plan["light"].value == wanted.plan["light"].value == "fat"
    assert told.plan["light"].why.startswith("as fat it leaves -")
    assert told.gaussians["u"].min() < 0.7 * Settings().light_u
    apart = np.abs(wanted.volume - soft.volume).mean()
    assert np.abs(told.volume - wanted.volume).mean() < apart


def test_less_than_two_standard_errors_is_no_answer(pancreas, small, monkeypatch):
    """Of views whose differences deviate by 0.7 %."""
    answer_with(monkeypatch, 0.001)
    told = reconstruct(pancreas, FEW_STEPS).plan["light"]
    assert told.value == "soft" and told.why.startswith("as fat it leaves -")


def beforehand(scan, **options):
    """The answer that a run begins with, if there is one."""
    return told_beforehand(scan, "light", **QUICK | FEW_STEPS | options)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"curves": 1}, "one material curve"),
        ({"light_u": 0.0}, "that of other soft matter"),
        ({"soft_u": 0.1}, "from water only"),
        ({"materials": ("pmma", "cortical_bone", "iron")}, "from water only"),
        ({"passes": 9.0}, "in so few passes"),
    ],
)
def test_nobody_asks_where_it_cannot_be_told(pancreas, small, settings, words):
    told = beforehand(pancreas, **settings)
    assert told.value == "soft" and told.status is Status.USUAL and words in told.why


def test_nobody_asks_where_voxels_are_few(pancreas, monkeypatch):
    told = reconstruct(pancreas, FEW_STEPS).plan["light"]
    assert told.value == "soft" and told.status is Status.USUAL and "fewer than 48 voxels" in told.why
    assert told == beforehand(pancreas)
    monkeypatch.setattr(light, "_FEWEST_VOXELS", 10)
    assert beforehand(pancreas) is None


def test_fat_of_one_energy_is_of_no_effect(pancreas):
    assert (
        "no effect" in reconstruct(pancreas, FEW_STEPS | {"light": "fat"}, spectrum=None).plan["curves"].why
    )


def test_neither_slices_nor_few_views_are_asked(small):
    fan = tps.simulate_scan("pancreas", size=15, views=VIEWS, geometry="fan")
    assert "slices" in beforehand(fan).why
    few = tps.simulate_scan("pancreas", size=15, views=39)
    assert "fewer than 40 views" in beforehand(few).why


def amid(fitter, clock=None):
    """The answer to the question in the middle of a run, and the run."""
    clock = clock or Clock(10, None)
    clock.done = clock.done or clock.steps // 2
    plan = planned(passes=15.0, curves=3, soft_reference={"number": 0.0})
    run, lab = Run(fitter, clock), Lab(None, None, Settings(), None, plan=plan)
    ask_between(lab, run, (Light,))
    return lab.plan.answers["light"], run


def test_it_is_due_once_in_the_middle_of_a_run():
    clock, lab = Clock(10, None), Lab(None, None, Settings(), None, plan=planned(light="soft"))
    ask_between(lab, Run(None, clock), (Light,))
    clock.done, lab.plan = 4, planned()
    ask_between(lab, Run(None, clock), (Light,))
    assert not lab.plan.answers


def fake_fitter(ahead, steps=30):
    other = SimpleNamespace(ahead=ahead, gaussians=None, scene=None)
    cloud = SimpleNamespace(shared_material=torch.zeros(1))
    return SimpleNamespace(ahead=ahead, branch=lambda light_u: other, steps_of_a_pass=steps, gaussians=cloud)


@pytest.fixture
def much_light(monkeypatch):
    monkeypatch.setattr(light, "_light_mass", lambda fitter: 0.5)
    monkeypatch.setattr(light, "tell_light", lambda *_: None)


@pytest.mark.parametrize("made", [[], [(0.2, 0.3, 1)]])
def test_a_budget_that_ends_amid_the_question_leaves_the_run_as_it_was(much_light, made):
    def slowly(clock, passes):
        clock.deadline = working_time() - 1
        return made

    fitter = fake_fitter(slowly)
    answer, run = amid(fitter, Clock(10, working_time() + 3600))
    assert run.fitter is fitter and run.made == (made[0] if made else None)
    assert answer.value == "soft" and "time budget" in answer.why


def test_a_budget_that_the_fit_needs_is_not_spent_on_it(much_light):
    def ahead(clock, passes):
        raise AssertionError("asked all the same")

    # Half of the time is gone, and of the steps there are 990 to make.
    clock = Clock(1000, working_time() + 10)
    clock.done, clock.begun = 10, working_time() - 10
    fitter = fake_fitter(ahead)
    answer, run = amid(fitter, clock)
    assert (run.fitter, run.made) == (fitter, None)
    assert answer.value == "soft" and "kept for the fit" in answer.why


@pytest.mark.parametrize(("share", "asked"), [(0.09, False), (0.11, True)])
def test_little_light_matter_is_left_alone(much_light, monkeypatch, share, asked):
    def ahead(clock, passes):
        clock.deadline = working_time() - 1
        return []

    monkeypatch.setattr(light, "_light_mass", lambda fitter: share)
    answer, _ = amid(fake_fitter(ahead))
    assert answer.value == "soft" and ("too little to matter" in answer.why) == (not asked)


def test_soft_matter_that_is_no_water_is_not_asked(much_light):
    fitter = fake_fitter(None)
    fitter.gaussians.shared_material -= 0.06
    answer, run = amid(fitter)
    assert (run.fitter, run.made) == (fitter, None)
    assert answer.value == "soft" and "number of its own" in answer.why


def test_a_gpu_without_room_for_another_cloud_goes_on_without_asking(much_light):
    def full(light_u):
        raise torch.cuda.OutOfMemoryError("no room")

    fitter = fake_fitter(None)
    fitter.branch = full
    answer, run = amid(fitter)
    assert (run.fitter, run.made) == (fitter, None)
    assert answer.value == "soft" and answer.why == "no room"


@pytest.mark.parametrize(("steps", "passes"), [(90, 2), (50, 2), (30, 4), (1, 4)])
def test_each_way_has_a_hundred_steps_but_no_more_than_a_quarter_of_the_run(much_light, steps, passes):
    asked = []

    def ahead(clock, some):
        asked.append(some)
        clock.deadline = working_time() - 1
        return []

    amid(fake_fitter(ahead, steps))
    assert asked == [passes, passes]


def test_a_run_resumed_around_the_question_is_the_uninterrupted_one(
    pancreas, found_fat, small, tmp_path, monkeypatch
):
    answer_with(monkeypatch, 0.01)
    monkeypatch.setattr("tomo_polysplat.plan.checkpoint._LARGEST_SHARE", 1e9)
    for share in (0.4, 0.5, 0.7):
        run = partial(reconstruct, pancreas)
        assert_same(resumed_after(share, run, tmp_path / f"{share}.npz"), found_fat, share)

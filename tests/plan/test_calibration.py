"""What a calibration is asked for, what it finds on a small scan, and what it leaves alone."""

import dataclasses
import time
from functools import cache

import numpy as np
import pytest
import torch
from planned import why
from small_scans import geometries, reconstruct

import tomo_polysplat as tps
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.physics.scatter import Scatter, light_around
from tomo_polysplat.plan.calibrated_physics import scatter_beside, with_fitted
from tomo_polysplat.plan.calibration import Calibration, _judge, _stage, calibrated
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.model import scene_of
from tomo_polysplat.plan.order import plan_from_start
from tomo_polysplat.plan.ray_sample import RaySample
from tomo_polysplat.plan.short_fit import ShortFit, main_density
from tomo_polysplat.settings import make_settings

# Enough steps for the density of the main matter to settle.
STEADY = {"passes": 4.0, "views_per_step": 8}
SPECTRUM = tps.Spectrum.from_tube(90, filters={"Al": 0.1})


@cache
def fan(scatter, views=40):
    return tps.simulate_scan("pins", size=48, views=views, geometry="fan", scatter=scatter, metal=False)


def of_fit(fitted, error, *, darkest=None, density=1.0, cut=False):
    """A short fit that left such errors, with one ray besides some dark ones, of which scatter would be a part."""
    rays, dark = RaySample(np.zeros((3, 1)), *np.zeros((5, 1))), np.full(400, 3.0)
    return ShortFit(
        fitted,
        error,
        error if darkest is None else darkest,
        dark,
        density,
        rays,
        fitted.get("scatter", 0.0),
        cut=cut,
    )


def test_rays_darker_than_scatter_speak_against_it_where_noise_does_not_explain_them():
    measured, light = np.full(50_000, 0.5), np.full(50_000, 0.8)
    measured[:30] = -np.log(0.005)
    rest = (np.zeros((3, 50_000)), measured, np.ones(50_000), light, np.zeros(50_000))
    bright, dim = (RaySample(*rest, np.exp(0.5 * measured) / photons**0.5) for photons in (1e5, 2e2))
    assert bright.darker_than(Scatter(0.02)) == 30 and bright.darker_than(Scatter(0.005)) == 0
    assert bright.darker_than(Scatter(0.024, -0.025)) == 0, "less behind matter"
    assert dim.darker_than(Scatter(0.02)) == 0, "one photon where four are expected"
    problem, wanted = problem_of(fan(0.0), SPECTRUM), Calibration(("scatter",), None, suspected=True)
    stage = [of_fit({"scatter": 0.02}, 0.4, darkest=0.4), of_fit({"beam": 1.02}, 0.5, darkest=0.99)]
    for rays, taken in ((bright, 1), (dim, 0)):
        chosen, why = _judge(
            "scatter", dataclasses.replace(of_fit({}, 1.0), rays=rays), stage, problem, wanted
        )
        assert chosen is stage[taken]


@pytest.mark.parametrize(
    ("error", "darkest", "taken"),
    [(0.85, 0.98, False), (0.85, 0.94, True), (0.6, 0.99, True), (0.6, 1.01, False)],
)
def test_scatter_that_does_not_show_beside_the_object_has_to_beat_the_fit_without_it(error, darkest, taken):
    """Errors of the model, as of too few voxels, look like scatter that is behind the object alone."""
    problem, stage = problem_of(fan(0.0), SPECTRUM), [of_fit({"scatter": 0.03}, error, darkest=darkest)]
    for suspected in (True, False):
        wanted = Calibration(("scatter",), None, suspected=suspected)
        chosen, _ = _judge("scatter", of_fit({}, 1.0), stage, problem, wanted)
        assert (chosen is stage[0]) == (taken or not suspected)


def problem_of(scan, spectrum):
    return Problem.of(scan.projections.swapaxes(0, 1), *geometries(scan), "cm", spectrum, None)


@pytest.mark.parametrize(
    "asked, names",
    [(True, ("scatter",)), ("scatter", ("scatter",)), (["scatter", "filter"], ("scatter", "filter"))],
)
def test_what_is_asked_for(asked, names):
    density = 1.0 if "filter" in names else None
    assert Calibration.of(asked, density, SPECTRUM) == Calibration(names, density)
    assert Calibration.of(False, None, SPECTRUM) is None
    assert Calibration.of(True, 1.05, SPECTRUM).names == ("scatter", "kvp")


@pytest.mark.parametrize(
    "asked, density, spectrum, word",
    [
        ("kvp", None, SPECTRUM, "known density"),
        (("kvp", "filter"), 1.0, SPECTRUM, "one known density"),
        ("voltage", None, SPECTRUM, "one of scatter"),
        (True, None, None, "a spectrum"),
        (False, 1.0, SPECTRUM, "calibrate beside it"),
        (True, -1.0, SPECTRUM, "soft_density"),
        (True, 1190.0, SPECTRUM, "kg/m3"),
        ("kvp", 1.0, tps.Spectrum(np.linspace(5, 15, 40), np.ones(40)), "x-ray tube"),
    ],
)
def test_what_makes_no_sense_is_refused(asked, density, spectrum, word):
    with pytest.raises(ValueError, match=word):
        Calibration.of(asked, density, spectrum)


def test_a_number_is_no_name():
    assert Calibration.of(np.True_, None, SPECTRUM) == Calibration(("scatter",), None)
    with pytest.raises(TypeError, match="calibrate: .*names"):
        Calibration.of(3, None, SPECTRUM)


def test_scatter_is_found_and_used():
    scan = fan(0.05)
    result = reconstruct(scan, valid=scan.valid, calibrate=True)
    found = result.plan["calibration"].value
    assert found["accepted"] == {"scatter": True}
    assert found["fitted"]["scatter"] == pytest.approx(0.05, rel=0.1)
    assert found["held_out_after"] < found["held_out_before"]
    assert result.spectrum == scan.spectrum


def test_without_scatter_the_result_is_as_if_nothing_had_been_asked():
    scan = fan(0.0)
    plain = reconstruct(scan, valid=scan.valid)
    asked = reconstruct(scan, valid=scan.valid, calibrate=True)
    assert asked.plan["calibration"].value["fitted"] == {}
    np.testing.assert_array_equal(asked.volume, plain.volume)


def test_a_known_density_brings_the_voltage_back():
    scan = fan(0.0, views=120)
    wrong = tps.Spectrum.from_tube(81, filters={"Al": 0.1})
    options = {"spectrum": wrong, "materials": ("pmma", "aluminium", "iron"), "settings": STEADY}
    result = reconstruct(scan, valid=scan.valid, calibrate="kvp", soft_density=1.19, **options)
    found = result.plan["calibration"].value
    assert found["accepted"] == {"kvp": True}
    assert 81 * found["fitted"]["kvp"] == pytest.approx(90, abs=4.5)
    assert result.energy_kev == result.spectrum.effective_energy > wrong.effective_energy


def test_a_short_fit_that_the_time_budget_ends_tells_nothing():
    scan = fan(0.05)
    result = reconstruct(scan, valid=scan.valid, calibrate=True, soft_density=1.19, time_budget=1e-3)
    found = result.plan["calibration"].value
    assert found["accepted"] == {"scatter": False, "kvp": False} and found["fitted"] == {}
    assert found["why"].count("the time budget is too short to tell") == 2 and len(found["trials"]) == 1


@pytest.mark.parametrize(
    "seconds, cut, made",
    [((0, 0), (False, True), 2), ((0.2, 0), (False, False), 1), ((0, 0), (False, False), 2)],
)
def test_a_stage_is_taken_where_its_short_fits_had_their_time(seconds, cut, made, monkeypatch):
    """The second would be taken for half the error of the first."""
    trials = []

    def fit(problem, start, fitted, *rest, **steps):
        trials.append(fitted)
        number = len(trials) - 1
        time.sleep(seconds[number])
        return of_fit(fitted, 0.5**number, cut=cut[number])

    monkeypatch.setattr("tomo_polysplat.plan.calibration.short_fit", fit)
    monkeypatch.setattr("tomo_polysplat.plan.calibration.first_volume", lambda *scan: (None, ""))
    monkeypatch.setattr(
        "tomo_polysplat.nuisances.scatter.estimate_scatter", lambda *rays, **free: (Scatter(0.05), 1.0)
    )
    monkeypatch.setattr(
        "tomo_polysplat.nuisances.scatter.misfit_left",
        lambda *rays, **free: 0.5 if rays[-1] != rays[-2] else 1.0,
    )
    problem, wanted = problem_of(fan(0.0), SPECTRUM), Calibration(("scatter",), None)
    found = calibrated(problem, wanted, make_settings(), torch.device("cpu"), 0, 0.6)
    taken = made == 2 and not any(cut)
    assert found["accepted"] == {"scatter": taken} and found["fitted"] == ({"scatter": 0.05} if taken else {})
    assert len(trials) == made and ("too short" in found["why"]) != taken


@pytest.mark.parametrize("noise, shown", [(0.003, True), (0.03, False)])
def test_air_shows_scatter_beyond_its_noise(noise, shown):
    """A median of 301 rays has an error of 0.07 deviations of one."""
    areal = np.zeros((3, 401))
    areal[0, 301:] = 2.0
    measured = np.where(areal[0] > 0, 0.5, -np.log1p(0.003))
    rays = RaySample(areal, measured, *np.ones((2, 401)), np.zeros(401), np.full(401, noise))
    found = scatter_beside(dataclasses.replace(of_fit({}, 1.0), rays=rays))
    assert found == ({"scatter": pytest.approx(0.003)} if shown else {})


@pytest.mark.parametrize(
    ("errors", "goes_on"),
    [
        ({0.003: 0.4, 0.001: 0.7, 0.004: 1.2}, {0.003: [0.0031, 0.0041], 0.001: [0.0011]}),
        ({0.003: 1.2, 0.001: 1.1, 0.004: 0.8}, {0.004: [0.0041, 0.0042]}),
    ],
)
def test_scatter_is_moved_from_each_short_fit_that_explains_more(errors, goes_on, monkeypatch):
    """Air shows 0.003 of the open beam, all rays 0.001 alone and 0.004 under a dimmer beam."""
    module = "tomo_polysplat.plan.calibration"
    # What each fit shows: scatter alone, or under the beam that it assumed, and with another beam.
    alone = {0.003: 0.0031, 0.001: 0.0011, 0.004: 0.0041}
    other = {0.003: 0.0041, 0.001: 0.0041, 0.004: 0.0042}

    def moved(fit, problem):
        at = fit.fitted.get("scatter")
        here, there = (0.001, 0.004) if at is None else (alone[at], other[at])
        beam = {"beam": fit.fitted["beam"]} if "beam" in fit.fitted else {}
        return [{"scatter": here} | beam, {"scatter": there, "beam": 0.99}]

    monkeypatch.setattr(f"{module}.scatter_beside", lambda first: {"scatter": 0.003})
    monkeypatch.setattr(f"{module}.moved_scatter", moved)
    problem, wanted = problem_of(fan(0.0), SPECTRUM), Calibration(("scatter",), None)
    stage = _stage(
        "scatter",
        of_fit({}, 1.0),
        wanted,
        problem,
        lambda fitted: of_fit(fitted, errors.get(fitted["scatter"], 2.0)),
    )
    tried = [fit.fitted["scatter"] for fit in stage]
    assert tried == [0.003, 0.001, 0.004, *(at for each in goes_on.values() for at in each)]


@pytest.mark.parametrize(
    ("error", "darkest", "taken"), [(0.38, 0.3, 1), (0.395, 0.3, 0), (0.38, 0.41, 0), (0.2, 0.5, 0)]
)
def test_scatter_under_another_beam_has_to_beat_the_best_that_explains_the_rays_alone(error, darkest, taken):
    problem, wanted = problem_of(fan(0.0), SPECTRUM), Calibration(("scatter",), None, suspected=True)
    stage = [
        of_fit({"scatter": 0.02}, 0.4, darkest=0.4),
        of_fit({"scatter": 0.03, "beam": 0.99}, error, darkest=darkest),
        of_fit({"beam": 1.02}, 0.7, darkest=0.99),
    ]
    chosen, why = _judge("scatter", of_fit({}, 1.0), stage, problem, wanted)
    assert chosen is stage[taken] and "accepted" in why
    assert ("a beam 0.99 times" in why) == bool(taken)
    # Where nothing explains the rays alone, both have to beat the fit without either.
    chosen, why = _judge("scatter", of_fit({}, 1.0), stage[1:2], problem, wanted)
    assert chosen is stage[1]
    chosen, why = _judge("scatter", of_fit({}, 0.19, darkest=0.2), stage[1:2], problem, wanted)
    assert chosen is None and "not accepted" in why


@pytest.mark.parametrize("kvp, density, factors", [(420, 3.0, (1.0, 450 / 420)), (22, 0.03, (20 / 22, 1.0))])
def test_a_voltage_stays_within_the_tables(kvp, density, factors):
    """A density that no voltage explains asks for one beyond their end."""
    scan, tube = fan(0.0), tps.Spectrum.from_tube(kvp, filters={"Al": 0.05})
    result = reconstruct(scan, spectrum=tube, valid=scan.valid, calibrate="kvp", soft_density=density)
    trials = result.plan["calibration"].value["trials"]
    assert len(trials) > 1
    assert all(factors[0] <= trial.get("kvp", 1.0) <= factors[1] for trial in trials)


def test_an_empty_scan_tells_nothing_about_the_tube():
    scan = fan(0.0)
    empty = np.zeros_like(scan.projections)
    result = reconstruct(scan, empty, calibrate="kvp", soft_density=1.0)
    assert result.plan["calibration"].value["accepted"] == {"kvp": False}
    assert not result.volume.any()


@pytest.mark.parametrize(
    ("factor", "held_out", "taken", "kvp"),
    [
        *((1.1, 1.0, True, 90), (1.1, 1.2, False, 90), (1.25, 0.9, False, 90), (0.8, 0.9, False, 90)),
        # The tables of tubes end before the factors do.
        *((450 / 420, 0.9, False, 420), (1.05, 0.9, True, 420)),
    ],
)
def test_a_density_is_not_followed_against_the_rays_or_past_the_end(factor, held_out, taken, kvp):
    problem = problem_of(fan(0.0), tps.Spectrum.from_tube(kvp, filters={"Al": 0.05}))

    def fit(fitted, error):
        return of_fit(fitted, error)

    stage = [fit({"kvp": factor}, held_out)]
    chosen, _ = _judge("kvp", fit({}, 1.0), stage, problem, Calibration(("kvp",), 1.0))
    assert chosen is (stage[0] if taken else None)


def test_other_physics_are_those_of_the_same_measurements():
    problem = problem_of(fan(0.0), SPECTRUM)
    other, device = with_fitted(problem, {"scatter": 0.01, "filter": 2.0}), torch.device("cpu")
    assert other.scatter == Scatter(0.01) and other.spectrum.effective_energy > SPECTRUM.effective_energy
    assert problem.scatter == Scatter() and problem.spectrum is SPECTRUM
    # On a GPU they would be copied there once for every short fit.
    assert other.measured(device) is problem.measured(device)


@pytest.mark.parametrize("fitted", [{"beam": 1.02}, {"scatter": 0.03, "scatter_of_light": -0.02}])
def test_a_brighter_beam_and_scatter_that_varies_are_taken_out_of_the_rays(fitted):
    problem, device = problem_of(fan(0.0), SPECTRUM), torch.device("cpu")
    plain, other = problem.measured(device), with_fitted(problem, fitted)
    light = torch.exp(-plain) / fitted.get("beam", 1.0)
    if "scatter" in fitted:
        light -= Scatter(*fitted.values()).at(light_around(plain))
    found = torch.exp(-other.measured(device)) - other.scatter_level(device)
    torch.testing.assert_close(found, light, rtol=1e-5, atol=1e-6)
    assert problem.measured(device) is plain


def test_whether_matter_is_inside_is_looked_up_once_whatever_the_physics(monkeypatch):
    seen = []

    def look(*scan):
        seen.append(scan)
        return True, "inside"

    monkeypatch.setattr("tomo_polysplat.fit.problem.matter_is_inside", look)
    problem, device, settings = problem_of(fan(0.0), SPECTRUM), torch.device("cpu"), make_settings()
    start, _ = first_volume(problem, device, settings)
    for of in (problem, with_fitted(problem, {"scatter": 0.01})):
        plan = plan_from_start(start, of, settings, device)
        assert scene_of(of, plan, settings, device).closed and why(plan, "window") == "inside"
    assert len(seen) == 1


def test_the_main_matter_is_where_voxels_crowd():
    rng = np.random.default_rng(1)
    density = rng.normal(1.05, 0.02, (19, 21, 23))
    density[:3], density[7, 8, :] = rng.uniform(0, 1.5, (3, 21, 23)), 7.9
    assert main_density(density) == pytest.approx(1.05, abs=0.01)
    assert main_density(density[9:10]) == pytest.approx(1.05, abs=0.01)
    assert main_density(np.zeros((5, 1, 3))) == 0.0


def test_metal_that_outweighs_the_rest_is_not_the_main_matter():
    density = np.full((19, 21, 23), 0.97)
    density[4:9, 6:13, 8:15] = 75.0
    assert main_density(density) == 75.0
    assert main_density(density, metal=6.0) == pytest.approx(0.97)


def test_walls_do_not_tell_their_density():
    density = np.zeros((19, 21, 23))
    density[::3] = 0.9  # one voxel thick, and lighter than they are
    assert main_density(density) == 0.0
    problem = problem_of(fan(0.0), SPECTRUM)
    before = of_fit({}, 1.0, density=main_density(density))
    wanted = Calibration(("scatter", "kvp"), 1.0)
    chosen, why = _judge("kvp", before, [], problem, wanted)
    assert chosen is None and "density" in why
    assert _judge("scatter", before, [], problem, wanted) == (None, "nothing to change")


@pytest.mark.parametrize(
    ("scatter", "beam", "taken"),
    [
        *((((0.5, 0.5), (0.6, 0.9), "scatter"), ((0.5, 0.9), (0.49, 0.8), "beam"))),
        # All rays far better, and the darkest no worse.
        *(
            (
                ((0.4, 0.9), (0.9, 0.91), "scatter"),
                ((0.9, 0.9), (0.4, 0.89), "beam"),
                ((0.4, 0.9), (0.9, 0.89), "scatter"),
            )
        ),
        # Not the darkest rays as well; both better than before, but for each other; neither better than before.
        *(
            (
                ((0.5, 1.1), None, None),
                ((0.6, 1.05), (0.65, 1.06), "scatter"),
                ((0.65, 1.05), (0.66, 1.06), "beam"),
            )
        ),
        *((((0.5, 0.9), (0.6, 0.8), "beam"), ((0.99, 0.9), (1.1, 0.95), None))),
    ],
)
def test_scatter_that_only_the_rays_ask_for_has_to_explain_the_darkest_and_beat_a_brighter_beam(
    scatter, beam, taken
):
    before, problem = of_fit({}, 1.0), problem_of(fan(0.0), SPECTRUM)
    stage = [of_fit({"scatter": 0.02}, scatter[0], darkest=scatter[1])]
    if beam is not None:
        stage.append(of_fit({"beam": 1.02}, beam[0], darkest=beam[1]))
    chosen, why = _judge("scatter", before, stage, problem, Calibration(("scatter",), None, suspected=True))
    assert ([*chosen.fitted] if chosen else []) == ([taken] if taken else [])
    assert ("not accepted" in why) == (taken is None)
    # Who asks for scatter means it.
    asked, _ = _judge("scatter", before, stage[:1], problem, Calibration(("scatter",), None))
    assert (asked is stage[0]) == (scatter[0] < 0.97)

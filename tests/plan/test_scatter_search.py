"""Scatter that nobody has told of: found in the middle of a run, which begins anew with it, and when nobody asks."""

import dataclasses
from functools import cache

import numpy as np
import pytest
import torch
from planned import told_beforehand

import tomo_polysplat as tps
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.scatter import light_around
from tomo_polysplat.plan import calibration, solver
from tomo_polysplat.plan.answer import Status
from tomo_polysplat.plan.preparation import prepare

QUICK = {"passes": 6.0, "views_per_step": 4, "tv_factor": 1.0, "edges": "blurred", "pixel_rays": 1}
# Of these runs only the course matters, or that two are the same to the bit.
ROUGH = QUICK | {"views_per_step": 12}


def asked(state):
    """A callback that ends a run once it has been asked."""
    return state.share > 0.4


@cache
def pins(scatter=0.0, views=48):
    return tps.simulate_scan("pins", size=36, views=views, geometry="fan", scatter=scatter)


def reconstruct(scan, **options):
    # Where the scanner stood is asked in other files.
    usual = {
        "unit": scan.unit,
        "spectrum": scan.spectrum,
        "settings": ROUGH,
        "progress": False,
        "align": False,
    }
    options = usual | options
    return tps.reconstruct(scan.projections, scan.proj_geom, scan.vol_geom, **options)


@cache
def usual(scatter=0.0, calibrate=None):
    """A run without anything special, which several tests compare with."""
    return reconstruct(pins(scatter), calibrate=calibrate)


def error(result, scan):
    return float(np.sqrt(np.mean((result.volume - scan.truth) ** 2)))


def test_scatter_that_nobody_told_of_is_modelled():
    scan = pins(0.05)
    found, told, without = (reconstruct(scan, settings=QUICK, calibrate=each) for each in (None, True, False))
    assert found.plan["scatter"].why.startswith("modelled: ")
    # Beside the object, where all light is around a ray: pins hardly tell one part from the other.
    fitted = found.plan["calibration"].value["fitted"]
    assert fitted["scatter"] + fitted.get("scatter_of_light", 0.0) == pytest.approx(0.05, rel=0.1)
    assert found.plan["scatter"].value == told.plan["scatter"].value
    # Begun anew, the run is that of a scan whose scatter was known from the first.
    assert np.array_equal(found.volume, told.volume)
    assert without.plan["scatter"].why == "not looked for: asked for"
    assert error(found, scan) < 0.6 * error(without, scan)


def test_a_scan_without_any_is_fitted_as_if_nobody_had_asked():
    asked, without = usual(), usual(0.0, False)
    assert asked.plan["scatter"].why.startswith("the rays show") and "calibration" not in asked.plan
    assert np.array_equal(asked.volume, without.volume)


@pytest.mark.parametrize(("scatter", "beam"), [(0.0, 1.0), (0.002, 1.0), (0.02, 0.98)])
def test_little_scatter_is_found_where_it_is_much_of_the_light_behind_metal(scatter, beam):
    """Two bolts in a bath, whose shadows together have as much scatter as light; no other ray has a hundredth of it.

    A source that is dimmer than its open field hides scatter beside the object.
    """
    views, columns, size = 60, 81, 41
    angles, across = np.arange(views) * np.pi / views, (np.arange(columns) - columns // 2) * 0.15
    spectrum = tps.Spectrum.from_tube(120, filters={"Al": 0.3}, detector="counting")
    depths = {"water": np.zeros((views, columns)), "iron": np.zeros((views, columns))}
    for x, y, radius, inside in ((0.0, 0.0, 4.0, 1.0), (1.5, 0.6, 0.6, -1.0), (-1.4, -0.5, 0.7, -1.0)):
        at = across - (x * np.cos(angles) + y * np.sin(angles))[:, None]
        chord = 2 * np.sqrt(np.maximum(radius**2 - at**2, 0.0))
        depths["water"] += inside * chord
        depths["iron"] += chord * 7.87 if inside < 0 else 0.0
    curves = {name: mass_attenuation(name, spectrum.energies) for name in depths}
    optical = sum(depths[name][..., None] * curves[name] for name in depths)
    counts = np.random.default_rng(8).poisson(1e5 * beam * (np.exp(-optical) @ spectrum.weights + scatter))
    result = tps.reconstruct(
        -np.log(np.maximum(counts, 0.5) / 1e5),
        {"type": "parallel", "DetectorWidth": 0.15, "DetectorCount": columns, "ProjectionAngles": angles},
        {
            "GridRowCount": size,
            "GridColCount": size,
            "option": dict(zip(("WindowMinX", "WindowMaxX", "WindowMinY", "WindowMaxY"), (-4.5, 4.5) * 2)),
        },
        spectrum=spectrum,
        unit="cm",
        settings=QUICK | {"views_per_step": 10},
        progress=False,
        align=False,
        callbacks=[asked],
    )
    told = result.plan["scatter"]
    if scatter:
        assert told.value["scatter"] == pytest.approx(scatter, rel=0.15)
        assert told.value.get("beam", 1.0) == pytest.approx(beam, abs=2e-3)
    else:
        assert told.value == {} and "calibration" not in result.plan


def test_a_beam_that_drifts_does_not_scatter():
    scan = pins()
    brighter = 0.02 * (1 + np.sin(np.arange(scan.projections.shape[1]) / 5.0))[None, :, None]
    drifting = dataclasses.replace(scan, projections=(scan.projections - brighter).astype(np.float32))
    assert "drift" in reconstruct(drifting, callbacks=[asked], settings=QUICK).plan["scatter"].why


def test_nobody_asks_where_it_cannot_be_told():
    few, one_energy = pins(0.05, 39), dataclasses.replace(pins(0.05), spectrum=None)
    for scan, words in ((few, "fewer than 40 views"), (one_energy, "one energy"), (pins(0.05), None)):
        told = told_beforehand(scan, "scatter", calibrate=print, **QUICK)
        assert told is None if words is None else told.status is Status.USUAL and words in told.why
    hasty = QUICK | {"views_per_step": 48}  # the volume is nothing to it
    told = reconstruct(pins(0.05), time_budget=0.01, settings=hasty).plan["scatter"]
    assert told.status is Status.USUAL and "time budget" in told.why


class Stopped(Exception):
    pass


@pytest.mark.parametrize("passes", [1, 4])
def test_an_interrupted_run_goes_on_whether_it_had_begun_anew_or_not(passes, tmp_path):
    scan, path, seen = pins(0.05), tmp_path / "fit.npz", []

    def stop(state):
        seen.append(state)
        if len(seen) > passes:
            raise Stopped

    whole = usual(0.05)
    with pytest.raises(Stopped):
        reconstruct(scan, checkpoint=path, callbacks=[stop])
    rest = reconstruct(scan, checkpoint=path, resume=True)
    assert whole.plan["scatter"].why.startswith("modelled: ")
    assert rest.plan["scatter"] == whole.plan["scatter"]
    assert np.array_equal(rest.volume, whole.volume)


def test_a_run_with_scatter_that_varies_goes_on_as_if_nothing_had_happened(tmp_path, monkeypatch):
    scan, path, seen = pins(), tmp_path / "fit.npz", []
    fitted = {"scatter": 0.08, "scatter_of_light": -0.07}
    found = {"fitted": fitted, "accepted": {"scatter": True}, "why": "told"}
    monkeypatch.setattr(solver, "calibrate", lambda *scan: found)
    light = light_around(torch.from_numpy(scan.projections.swapaxes(0, 1).copy())).numpy().swapaxes(0, 1)
    scattered = -np.log(np.exp(-scan.projections) + 0.08 - 0.07 * light).astype(np.float32)
    scan = dataclasses.replace(scan, projections=scattered)

    def stop(state):
        seen.append(state)
        if len(seen) > 4:
            raise Stopped

    whole = reconstruct(scan)
    assert whole.plan["scatter"].why.endswith("0.08 of the open beam and -0.07 of the light around a ray")
    assert error(whole, scan) < 0.7 * error(reconstruct(scan, calibrate=False), scan)
    with pytest.raises(Stopped) as stopped:
        reconstruct(scan, checkpoint=path, callbacks=[stop])
    # What ended the first fit is not behind what ends the second.
    assert stopped.value.__context__ is None
    assert np.array_equal(reconstruct(scan, checkpoint=path, resume=True).volume, whole.volume)


def test_what_ends_the_short_fits_does_not_end_the_run(monkeypatch, caplog):
    def no_room(*scan, **options):
        raise RuntimeError("out of memory")

    monkeypatch.setattr(calibration, "short_fit", no_room)
    result = reconstruct(pins(0.05))
    assert result.plan["scatter"].why == "out of memory" and "out of memory" in caplog.text
    left_in = reconstruct(pins(0.05), calibrate=False, settings=ROUGH | {"beam": False})
    assert np.array_equal(result.volume, left_in.volume)


def test_a_beam_that_may_drift_is_left_alone_where_no_air_tells():
    scan = pins(0.05)
    cut = scan.projections.copy()
    cut[..., :8] = cut[..., -8:] = np.nan
    told = reconstruct(dataclasses.replace(scan, projections=cut), callbacks=[asked]).plan["scatter"]
    assert "too few rays" in told.why


def test_scatter_shows_where_rays_are_straight_sums():
    """Beside the object, though nothing is hardened."""
    spectrum = tps.Spectrum([60.0, 60.5], [0.5, 0.5])
    scan = pins()
    projections = -np.log(np.exp(-scan.projections) + 0.05).astype(np.float32)
    sums = dataclasses.replace(scan, projections=projections)
    told = reconstruct(sums, spectrum=spectrum, callbacks=[asked]).plan["scatter"]
    assert told.status is Status.ASKED and not told.why.startswith("the rays show")


def test_ctrl_c_while_it_begins_anew_returns_what_it_had_come_to(monkeypatch):
    begun = []

    def once(*scan, **more):
        begun.append(scan)
        if len(begun) > 1:
            raise KeyboardInterrupt
        return prepare(*scan, **more)

    monkeypatch.setattr(solver, "prepare", once)
    result = reconstruct(pins(0.05))
    assert result.plan["stop"].value == "interrupted" and len(begun) == 2
    assert result.history and result.plan["scatter"].why.startswith("not modelled: interrupted")
    assert result.volume.sum() == pytest.approx(pins(0.05).truth.sum(), rel=0.3)

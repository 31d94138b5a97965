"""What reconstruct accepts, ignores and refuses."""

import copy
import logging
import math

import astra
import numpy as np
import pytest
import torch
from small_scans import QUICK, fan, in_two_dimensions, posed, reconstruct, relative

import tomo_polysplat as tps
from tomo_polysplat.settings import make_settings


@pytest.fixture(scope="module")
def expected():
    return reconstruct(fan())


def as_big_endian(array):
    return array.astype(">f4")


def as_fortran(array):
    return np.asfortranarray(array)


def as_strided(array):
    return np.repeat(array, 2, axis=2)[..., ::2]


def as_torch(array):
    return torch.from_numpy(array.copy())


def same_problem(one, other):
    """Whether two calls pose the same problem, to the bit."""
    (one, _), (other, _) = one, other
    assert one.projections.dtype == other.projections.dtype and one.projections.flags.c_contiguous
    return np.array_equal(one.projections, other.projections, equal_nan=True)


@pytest.mark.parametrize(
    "change", [np.float64, as_big_endian, as_fortran, as_strided, as_torch, np.ndarray.tolist]
)
def test_the_form_of_an_array_does_not_matter(change):
    scan = fan()
    assert same_problem(posed(scan, change(scan.projections)), posed(scan))


def test_two_forms_of_an_array_give_one_volume(expected):
    scan = fan()
    assert np.array_equal(
        reconstruct(scan, as_strided(as_big_endian(scan.projections))).volume, expected.volume
    )


def test_half_precision_is_what_it_says():
    half = fan().projections.astype(np.float16)
    assert same_problem(posed(fan(), half), posed(fan(), half.astype(np.float32)))


def test_nothing_handed_over_is_written_to(expected):
    scan = fan()
    projections, valid = scan.projections.copy(), np.ones(scan.projections.shape, bool)
    projections[0, 3, 4:9], valid[0, 5] = np.nan, False
    before = projections.copy(), copy.deepcopy((scan.proj_geom, scan.vol_geom))
    projections.flags.writeable = valid.flags.writeable = False
    reconstruct(scan, projections, valid=valid)
    assert np.array_equal(projections, before[0], equal_nan=True)
    for now, then in zip((scan.proj_geom, scan.vol_geom), before[1]):
        assert set(now) == set(then) and all(np.all(now[key] == then[key]) for key in now)


def spoilt():
    scan = fan()
    bad = np.zeros(scan.projections.shape, bool)
    bad[0, 4, 20:24] = bad[0, 11] = bad[0, :, 60] = True
    return scan, bad


@pytest.fixture(scope="module")
def marked():
    scan, bad = spoilt()
    return reconstruct(scan, np.where(bad, 7.0, scan.projections), valid=~bad)


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf, 1e30, -1e6])
def test_rays_that_say_nothing_are_ignored_and_counted(value, marked):
    """Whatever they hold, and however they are marked."""
    scan, bad = spoilt()
    held = posed(scan, np.where(bad, np.float32(value), scan.projections))
    assert same_problem(held, posed(scan, np.where(bad, 7.0, scan.projections), valid=~bad))
    kind = "rays_out_of_range" if math.isfinite(value) else "rays_not_finite"
    assert held[1][kind] == marked.counts["rays_marked_invalid"] == bad.sum()
    assert marked.counts["rays_not_finite"] == marked.counts["rays_out_of_range"] == 0


def test_ignored_rays_give_the_volume_of_marked_ones(marked):
    scan, bad = spoilt()
    held = reconstruct(scan, np.where(bad, np.float32(np.nan), scan.projections))
    assert np.array_equal(marked.volume, held.volume) and held.counts["rays_not_finite"] == bad.sum()


def test_ignored_rays_cost_little(expected, marked):
    scan = fan()
    soft = (scan.truth > 0.1) & (scan.truth < 0.5)
    assert np.abs(marked.volume - expected.volume)[soft].mean() < 0.1 * scan.truth[soft].mean()


def test_a_masked_array_masks(marked):
    scan, bad = spoilt()
    masked = np.ma.MaskedArray(np.where(bad, np.float32(3.0), scan.projections), bad)
    result = reconstruct(scan, masked)
    assert result.counts["rays_marked_invalid"] == bad.sum()
    assert np.array_equal(result.volume, marked.volume)


@pytest.mark.parametrize("polychromatic", [True, False])
@pytest.mark.parametrize("value", [0.0, -0.5])
def test_a_scan_of_nothing_is_a_volume_of_nothing(polychromatic, value, caplog, recwarn):
    scan = fan()
    with caplog.at_level(logging.WARNING):
        result = reconstruct(
            scan,
            np.zeros_like(scan.projections) + np.float32(value) * (scan.projections > 0.5),
            spectrum=scan.spectrum if polychromatic else None,
        )
    assert np.isfinite(result.volume).all() and np.abs(result.volume).max() < 0.03
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]
    if value == 0:
        assert not result.volume.any() and result.counts["gaussians"] == 0
        assert "empty" in caplog.text and "empty" in result.plan["stop"].why


@pytest.mark.parametrize("views", [1, 2, 3])
@pytest.mark.parametrize("flat", [True, False], ids=["2D", "3D"])
def test_a_few_views_are_explained_though_not_enough(views, flat):
    scan = fan(False)
    chosen = np.linspace(0, 25, views).astype(int)
    projections, proj_geom, vol_geom = in_two_dimensions(scan)
    if flat:
        part = projections[chosen]
    else:
        part, proj_geom, vol_geom = scan.projections[:, chosen], astra.geom_2vec(scan.proj_geom), None
    proj_geom = proj_geom | {"Vectors": proj_geom["Vectors"][chosen]}
    result = reconstruct(scan, part, proj_geom, vol_geom, settings={"passes": 6.0})
    assert np.isfinite(result.volume).all()
    first, last = result.history[0]["loss"], result.history[-1]["loss"]
    assert last < 0.5 * first


@pytest.mark.parametrize("columns", [1, 3])
def test_a_detector_of_a_few_pixels_does_not_fail(columns):
    scan = fan(False)
    low = (scan.columns - columns) // 2
    vectors = astra.geom_2vec(scan.proj_geom)["Vectors"]
    proj_geom = astra.create_proj_geom("cone_vec", 1, columns, vectors)
    result = reconstruct(scan, scan.projections[..., low : low + columns], proj_geom)
    assert np.isfinite(result.volume).all() and result.volume.max() > 0.05


REFUSED = {
    "all NaN": (lambda s: {"projections": s.projections * np.nan}, ValueError, "projections.*usable ray"),
    "nothing valid": (lambda s: {"valid": s.projections < -9}, ValueError, "projections.*usable ray"),
    "intensities": (lambda s: {"projections": s.projections + 3e4}, ValueError, "not intensities"),
    "axes swapped": (
        lambda s: {"projections": s.projections.swapaxes(0, 1)},
        ValueError,
        "projections: expected shape",
    ),
    "no numbers": (lambda s: {"projections": np.full(s.projections.shape, "x")}, TypeError, "real numbers"),
    "complex": (lambda s: {"projections": s.projections + 0j}, TypeError, "real numbers"),
    "mask of another shape": (lambda s: {"valid": np.ones((3, 4))}, ValueError, "valid: expected shape"),
    "unknown unit": (lambda s: {"unit": "inch"}, ValueError, "unit: expected one of m, cm, mm, um, pixel"),
    "pixels with a spectrum": (lambda s: {"unit": "pixel"}, ValueError, "unit: .*real lengths"),
    "unknown quality": (lambda s: {"quality": "superb"}, ValueError, "quality: expected one of fast"),
    "unknown setting": (lambda s: {"settings": {"pases": 3}}, ValueError, "settings: .*'pases'.*passes"),
    "unknown loss": (lambda s: {"settings": {"loss": "l3"}}, ValueError, r"settings\['loss'\]: .*huber"),
    "passes in words": (lambda s: {"settings": {"passes": "ten"}}, TypeError, r"settings\['passes'\]"),
    "half a view": (lambda s: {"settings": {"views_per_step": 1.5}}, ValueError, "whole number"),
    "endless": (lambda s: {"settings": {"passes": np.inf}}, ValueError, r"settings\['passes'\]: .*finite"),
    "seeds without a width": (
        lambda s: {"settings": {"seed_width": 0}},
        ValueError,
        r"settings\['seed_width'\]",
    ),
    "a perfect model": (lambda s: {"settings": {"model_error": 0}}, ValueError, r"settings\['model_error'\]"),
    "a blur with a dip": (lambda s: {"settings": {"blur": 1.0}}, ValueError, r"settings\['blur'\]: .*0.6"),
    "denser than dense": (lambda s: {"settings": {"metal_u": 1.5}}, ValueError, r"settings\['metal_u'\]"),
    "all held out": (lambda s: {"settings": {"held_out": 1.0}}, ValueError, r"settings\['held_out'\]"),
    "unknown kernel": (
        lambda s: {"settings": {"kernel": "magic"}},
        ValueError,
        r"kernel'\]: expected one of auto",
    ),
    "unknown device": (lambda s: {"device": "abacus"}, ValueError, "device: expected auto, cpu, cuda"),
    "other device": (lambda s: {"device": "meta"}, ValueError, "device: expected auto, cpu, cuda"),
    "absent device": (lambda s: {"device": "cuda:99"}, ValueError, "device: .*'cuda:99'"),
    "no time": (lambda s: {"time_budget": 0}, ValueError, "time_budget: .*> 0"),
    "time in words": (lambda s: {"time_budget": "long"}, TypeError, "time_budget: expected a number"),
    "negative seed": (lambda s: {"seed": -1}, ValueError, "seed: .*>= 0"),
    "half a seed": (lambda s: {"seed": 0.5}, ValueError, "seed: expected a whole number"),
    "no function": (lambda s: {"callbacks": [3]}, TypeError, "callbacks: expected functions"),
    "two materials": (lambda s: {"materials": ("water", "iron")}, (ValueError, TypeError), "material"),
    "no geometry": (lambda s: {"proj_geom": {"type": "spiral"}}, ValueError, "proj_geom type"),
    "two dimensions of volume": (
        lambda s: {"vol_geom": astra.create_vol_geom(48, 48)},
        ValueError,
        "vol_geom: expected a 3D one",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_does_not_fit_is_refused_with_its_name(case):
    make, error, words = REFUSED[case]
    scan = fan()
    threads = torch.get_num_threads()
    with pytest.raises(error, match=words):
        reconstruct(scan, **make(scan))
    assert torch.get_num_threads() == threads


def test_one_function_is_a_callback_too():
    seen = []
    reconstruct(fan(), callbacks=seen.append)
    assert len(seen) == 2


def test_settings_can_be_an_object():
    from tomo_polysplat.settings import Settings

    named = reconstruct(fan(), settings=QUICK | {"seed_spacing": 2.0})
    whole = reconstruct(fan(), settings=Settings(**QUICK, seed_spacing=2.0))
    assert np.array_equal(named.volume, whole.volume)
    assert named.settings["seed_spacing"] == 2.0 and named.plan["seed_spacing"].why == "asked for"


def test_materials_are_a_choice(expected):
    named = reconstruct(fan(), materials=("water", "aluminium", "iron"))
    assert np.array_equal(named.volume, expected.volume)
    titanium = reconstruct(fan(), materials=tps.Materials(dense="titanium"))
    assert relative(titanium.volume, expected.volume) > 1e-3
    assert "titanium" in str(titanium.materials)


def test_the_blur_that_was_used_is_told(expected):
    assert "fitted" in expected.plan["detector_blur"].why
    held = reconstruct(fan(), settings=QUICK | {"blur": 0.2, "learning_rate_blur": 0.0})
    assert "0.200" in held.plan["detector_blur"].why and "held" in held.plan["detector_blur"].why
    thin = reconstruct(fan(), settings=QUICK | {"blur": 0.0, "learning_rate_blur": 0.0})
    assert "infinitely thin" in thin.plan["detector_blur"].why
    assert relative(held.volume, thin.volume) > 1e-3


def test_a_scan_brings_all_that_it_knows():
    scan = fan()
    whole = tps.reconstruct(scan, settings=QUICK, progress=False)
    parts = tps.reconstruct(
        scan.projections, scan.proj_geom, scan.vol_geom, spectrum=scan.spectrum, unit=scan.unit, valid=scan.usable,
        settings=QUICK, progress=False,
    )  # fmt: skip
    assert np.array_equal(whole.volume, parts.volume) and whole.spectrum == scan.spectrum
    with pytest.raises(ValueError, match="proj_geom: .*pass a Scan"):
        tps.reconstruct(scan.projections)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *(("seed_spacing", 1e4), ("closer_seeds", 1e3), ("largest_scale", 1e-3), ("smallest_scale", 100)),
        *(("seed_width", 1e-3), ("support_level", 5), ("final_rate", 1e9)),
        *(("learning_rate_scale", 1e3), ("learning_rate_position", 1e4)),
    ],
)
def test_settings_that_would_empty_the_volume_are_refused(name, value):
    """With each of these the mean of a fan's volume was a third of what it is or less, or ten times as much."""
    with pytest.raises(ValueError, match=rf"settings\['{name}'\]: .*(<=|>=)"):
        make_settings("balanced", {name: value})

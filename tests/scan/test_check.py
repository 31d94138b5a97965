"""Planted defects are found, named and measured; clean scans have none."""

import tracemalloc
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from one_probe import answer

import tomo_polysplat as tps
from tomo_polysplat.cli import main
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.check import check_scan
from tomo_polysplat.scan.dropouts import dropped_rays
from tomo_polysplat.scan.io import save_scan
from tomo_polysplat.scan.probes.measured import Measured
from tomo_polysplat.scan.probes.rays import DEAD, STARVED, bad_rays
from tomo_polysplat.simulate.phantom import Part, Phantom
from tomo_polysplat.simulate.scanner import Scanner
from tomo_polysplat.simulate.scenes import scan_phantom, simulate_scan
from tomo_polysplat.simulate.shapes import cylinder

# One of each beam, in which defects are planted; a clean scan shows none whatever is in it.
SCANS = [("teeth", "cone"), ("lung", "fan"), ("pins", "parallel")]
CLEAN = [*SCANS, ("pepper", "cone"), ("pancreas", "parallel")]
# As many views as columns: what tells axes apart cannot be their lengths.
SIZE, VIEWS = 40, 60


@cache
def simulated(scene, geometry):
    return simulate_scan(scene, SIZE, VIEWS, geometry=geometry)


@pytest.fixture(params=SCANS, ids="-".join)
def scan(request):
    return simulated(*request.param)


def defects(scan):
    return {finding.probe: finding for finding in check_scan(scan) if finding.verdict == "defect"}


def views(scan, order):
    """The same geometry with the views in another order."""
    valid = None if scan.valid is None else scan.valid[:, order]
    return replace(scan, projections=scan.projections[:, order], valid=valid)


def is_parallel(scan):
    return scan.proj_geom["type"].startswith("parallel")


@pytest.mark.parametrize(("scene", "geometry"), CLEAN, ids=map("-".join, CLEAN))
def test_a_clean_scan_has_no_defect(scene, geometry):
    scan = simulated(scene, geometry)
    found = check_scan(scan)
    assert not [finding for finding in found if finding.verdict == "defect"]
    unknown = {finding.probe for finding in found if finding.verdict == "unknown"}
    # Detail may hide the noise, and metal is denser than other matter.
    unknown -= {"base of the logarithm", "unit of length"}
    assert unknown == ({"direction of the angles"} if is_parallel(scan) else set())


def test_turned_angles(scan):
    turned = views(scan, slice(None, None, -1))
    if is_parallel(scan):
        finding = answer(turned, "direction of the angles")
        assert finding.verdict == "unknown" and "mirror image" in finding.text
        assert not defects(turned)
    else:
        assert set(defects(turned)) == {"direction of the angles"}


@pytest.mark.parametrize("offset", [1.5, -1.5])
def test_an_offset_is_measured_and_the_remedy_mends_it(scan, offset):
    import astra

    moved = replace(scan, proj_geom=astra.geom_postalignment(scan.proj_geom, (offset, 0.0)))
    found = defects(moved)
    assert set(found) == {"centre"}
    shift = float(found["centre"].remedy.split("(proj_geom, (")[1].split(",")[0])
    assert shift == pytest.approx(-offset, abs=0.2)
    assert not defects(replace(moved, proj_geom=astra.geom_postalignment(moved.proj_geom, (shift, 0.0))))


def test_an_axis_of_a_parallel_beam_far_off_is_found():
    """Beyond what opposite rays are compared at: by a fifth of the columns."""
    import astra

    scan = simulate_scan("pancreas", SIZE, VIEWS, geometry="parallel", arc_degrees=360)
    offset = 0.2 * scan.columns
    found = answer(replace(scan, proj_geom=astra.geom_postalignment(scan.proj_geom, (offset, 0.0))), "centre")
    assert found.verdict == "defect" and found.values["offset"] == pytest.approx(offset, abs=0.2)


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (lambda p: np.exp(-p), "transmissions"),
        (lambda p: 4e4 * np.exp(-p), "counts"),
        (np.negative, "sign"),
    ],
    ids=["transmission", "counts", "sign"],
)
def test_a_missing_logarithm(scan, change, word):
    found = defects(replace(scan, projections=change(scan.projections)))
    assert set(found) == {"logarithm"} and word in found["logarithm"].text


@pytest.mark.parametrize("axes", [(0, 2), (1, 2)], ids=str)
def test_swapped_axes(axes):
    """Only axes of equal length can be swapped without anything else noticing."""
    for scene, geometry in CLEAN:
        if geometry == "fan" and 0 in axes:
            continue
        scan = simulated(scene, geometry)
        assert scan.views == scan.columns
        found = defects(replace(scan, projections=scan.projections.swapaxes(*axes), valid=None))
        assert set(found) == {"order of axes"}, (scene, geometry)
        assert str(axes).strip("()") in found["order of axes"].remedy


@pytest.mark.parametrize("value", [0.0, 9.0, np.nan], ids=str)
def test_dead_pixels(scan, value):
    dead = np.random.default_rng(0).random((scan.rows, scan.columns)) < 0.02
    bad = scan.projections.copy()
    bad.swapaxes(1, 2)[dead] = value
    found = defects(replace(scan, projections=bad, valid=np.isfinite(bad)))
    assert set(found) == {"bad rays"} and "dead pixels" in found["bad rays"].text


def test_a_pixel_without_light_is_dead_though_metal_is_beside_it_at_times():
    """Opaque matter that hides a pixel in all views is there in all of them."""
    scan = simulated("pins", "parallel")
    dark = scan.projections > 0.7 * scan.projections.max()
    column = int(dark.mean(axis=(0, 1)).argmax())
    assert 0.05 < dark[:, :, column].mean() < 0.6
    bad = scan.projections.copy()
    bad[:, :, column] = np.inf
    kinds = bad_rays(Measured(replace(scan, projections=bad, valid=np.isfinite(bad))))
    assert kinds[DEAD][:, :, column].all() and not kinds[STARVED].any()


def test_zeros_in_single_rays(scan):
    bad = scan.projections.copy()
    bad[np.random.default_rng(0).random(bad.shape) < 0.02] = 0
    assert "zero in the middle" in defects(replace(scan, projections=bad))["bad rays"].text


def test_saturation(scan):
    limit = np.percentile(scan.projections, 98)
    found = defects(replace(scan, projections=np.minimum(scan.projections, limit)))
    assert "limit of the scale" in found["bad rays"].text


def test_truncation(scan):
    cut = scan.columns // 3
    part = slice(cut, scan.columns - cut)
    geometry = dict(scan.proj_geom)
    geometry["DetectorColCount"] = scan.columns - 2 * cut
    valid = None if scan.valid is None else scan.valid[..., part]
    found = defects(replace(scan, projections=scan.projections[..., part], valid=valid, proj_geom=geometry))
    assert "truncation" in found and "first column" in found["truncation"].text


def test_a_detector_that_is_offset_on_purpose_is_not_truncation():
    import astra

    scan = simulated("teeth", "cone")
    cut = scan.columns // 3
    geometry = dict(scan.proj_geom)
    geometry["DetectorColCount"] = scan.columns - cut
    geometry = astra.geom_postalignment(geometry, (cut / 2, 0.0))
    half = replace(scan, projections=scan.projections[..., cut:], valid=None, proj_geom=geometry)
    assert not defects(half)
    assert "on purpose" in answer(half, "truncation").text


def test_disorder_of_views(scan):
    shuffled = defects(views(scan, np.random.default_rng(1).permutation(VIEWS)))
    assert set(shuffled) == {"order of views"} and "order of the files" in shuffled["order of views"].remedy
    order = np.arange(VIEWS)
    order[[13, 33]] = order[[33, 13]]
    found = defects(views(scan, order))
    # Among views that hardly differ one of the two may pass.
    named = {int(word.strip(",")) for word in found["order of views"].text.split() if word[0].isdigit()}
    assert set(found) == {"order of views"} and named and named <= {13, 33}


def test_views_in_any_order_with_their_angles_are_fine():
    """Golden-angle scans and the like: it is the angle that counts, not the place in the file."""
    from tomo_polysplat.scan.layout import vector_form

    scan = simulated("teeth", "cone")
    order = np.random.default_rng(1).permutation(VIEWS)
    geometry = dict(vector_form(scan.proj_geom))
    geometry["Vectors"] = geometry["Vectors"][order]
    assert not defects(replace(views(scan, order), proj_geom=geometry))


def test_an_empty_scan_breaks_nothing():
    scan = simulate_scan("pins", 12, 20)
    for empty in (np.zeros_like(scan.projections), np.full_like(scan.projections, np.nan)):
        first, *others = check_scan(replace(scan, projections=empty, valid=np.isfinite(empty)))
        assert first.probe == "bad rays"
        assert {finding.verdict for finding in others} == {"unknown"}


def test_the_command_describes_a_scan_without_a_good_ray(tmp_path, capsys):
    scan = simulate_scan("pins", 12, 20)
    nothing = np.zeros(scan.projections.shape, bool)
    save_scan(replace(scan, valid=nothing), tmp_path / "nothing.npz")
    assert main(["check", str(tmp_path / "nothing.npz")]) == 3
    printed = capsys.readouterr().out
    assert "none that is good" in printed and "100 % of dead pixels" in printed


def test_two_columns_tell_nothing():
    scan = simulate_scan("pins", 12, 30, columns=2)
    assert {finding.verdict for finding in check_scan(scan)[1:]} == {"unknown"}


def test_looking_for_bad_rays_takes_few_times_the_memory_of_what_is_looked_at():
    scan = simulate_scan("pins", 8, 13, rows=128, columns=128, noise=False)
    large = replace(
        scan,
        projections=np.repeat(scan.projections, 8, axis=0),
        proj_geom=scan.proj_geom | {"DetectorRowCount": 1024},
    )
    measured = Measured(large)
    assert measured.level > 0
    tracemalloc.start()
    bad_rays(measured)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20 * large.projections.nbytes


def test_a_column_of_half_of_the_light_is_found_or_named_with_what_would_tell():
    scan = simulated("teeth", "cone")
    for column, verdict in ((5, "defect"), (scan.columns // 2, "unknown")):
        values = scan.projections.copy()
        values[..., column] += np.log(2)
        finding = check_scan(replace(scan, projections=values))[0]
        assert finding.probe == "bad rays" and finding.verdict == verdict
    assert f"column {column}" in finding.text and "without the object" in finding.remedy


def test_the_command_prints_the_remedy_and_its_status_tells(tmp_path, capsys):
    scan = simulated("teeth", "cone")
    save_scan(scan, tmp_path / "good.npz")
    save_scan(views(scan, slice(None, None, -1)), tmp_path / "bad.npz")
    assert main(["check", str(tmp_path / "good.npz")]) == 0
    assert "MEND" not in capsys.readouterr().out
    assert main(["check", str(tmp_path / "bad.npz")]) == 3
    printed = capsys.readouterr().out
    assert "MEND" in printed and "-> take the angles times -1" in printed


# Zeros that fill in for a measurement


def test_zeros_within_the_object_are_dropouts_and_air_is_not():
    row = np.zeros(30)
    row[5:12] = [1, 2, 2.4, 2.5, 2.4, 2, 1]
    row[13:20] = [1, 2, 2.4, 2.5, 2.4, 2, 1]
    assert not dropped_rays(row).any(), "air between two objects"
    row[[8, 15, 16]] = 0
    assert np.flatnonzero(dropped_rays(row)).tolist() == [8, 15, 16]
    row[7] = np.nan
    assert np.flatnonzero(dropped_rays(row)).tolist() == [15, 16]
    assert not dropped_rays(np.zeros((3, 2))).any() and not dropped_rays(np.ones((3, 9))).any()


@pytest.mark.parametrize("pins, many", [(3, 20), (4, 24), (5, 24)])
def test_an_object_that_looks_the_same_from_several_sides_is_in_order(pins, many):
    """A view is like those a third of a turn away, but its neighbours are nearer than the views beyond them."""
    around = 2 * np.pi * np.arange(pins) / pins
    parts = [Part(cylinder((0.6 * np.cos(a), 0.6 * np.sin(a), 0), 0.12, 0.6), "pmma", 1.19) for a in around]
    geometry = tps.parallel_geometry(pixel=0.05, degrees=np.arange(many) * (360 / many), detector=(16, 40))
    spectrum = Spectrum.from_tube(90, filters={"Al": 0.1})
    symmetric = scan_phantom(Phantom(parts), *geometry, spectrum, Scanner(1e5, seed=0))
    assert "order of views" not in defects(symmetric)
    assert "order of views" in defects(views(symmetric, np.random.default_rng(0).permutation(many)))

"""`check` of objects and noise that tell nothing about directions and orders."""

from dataclasses import replace

import numpy as np
import pytest
from one_probe import answer

import tomo_polysplat as tps
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.probes.order import _shows
from tomo_polysplat.simulate.phantom import Part, Phantom
from tomo_polysplat.simulate.scanner import Scanner
from tomo_polysplat.simulate.scenes import scan_phantom, simulate_scan
from tomo_polysplat.simulate.shapes import box


@pytest.mark.parametrize("size, views, seed", [(28, 73, 5), (24, 53, 6), (24, 53, 0)])
def test_an_object_that_is_its_mirror_image_tells_no_direction(size, views, seed):
    scan = simulate_scan("pins", size, views, geometry="fan", metal=False, photons=3e4, seed=seed)
    assert str(answer(scan, "direction of the angles").verdict) == "unknown"


class _Noise:
    """Squared differences of views with as much error each."""

    def error(self, squared):
        return np.full(np.shape(squared), 4e-4)


@pytest.mark.parametrize("between, misplaced", [(1e-5, True), (-4.5e-3, False)])
def test_a_difference_far_below_nothing_says_that_the_noise_is_not_known(between, misplaced):
    nearer, between, like = np.array([[3e-3], [between], [-1.1e-3]])
    assert _shows(_Noise(), nearer, between, like, 1e-4, 1.3e-2).tolist() == [misplaced]


def test_one_view_of_few_photons_at_the_border_is_no_object():
    scan = simulate_scan("pins", 24, 48, geometry="fan", metal=False, photons=1e5)
    for views, told in ((1, "ok"), (3, "defect")):
        values = scan.projections.copy()
        values[:, 7 : 7 + views, :2] += 0.9
        assert str(answer(replace(scan, projections=values), "truncation").verdict) == told


@pytest.mark.parametrize("views, columns", [(44, 47), (84, 47), (96, 47)])
def test_a_plate_seen_edge_on_is_in_its_place(views, columns):
    """Only the view from its other end is like that one."""
    spectrum = Spectrum.from_tube(120, filters={"Al": 0.2}, detector="counting")
    turn = {"degrees": np.arange(views) * (360 / views), "detector": (9, columns), "pixel": 0.07}
    geometry = tps.cone_geometry(source_object=8.0, source_detector=16.0, **turn)
    plate = Phantom([Part(box((0, 0, 0), (0.5, 0.02, 0.3)), "lead", 11.3)])
    scan = scan_phantom(plate, *geometry, spectrum, Scanner(3e4, seed=1))
    assert str(answer(scan, "order of views").verdict) == "unknown"


def test_views_exchanged_with_those_half_a_turn_away_are_found():
    scan = simulate_scan("lung", 24, 60, geometry="cone", photons=3e4, seed=2)
    order = np.arange(60)
    order[[13, 43]] = order[[43, 13]]
    found = answer(replace(scan, projections=scan.projections[:, order]), "order of views")
    assert str(found.verdict) == "defect" and {"13", "43"} & set(found.text.replace(",", "").split())


def test_the_size_of_light_matter_is_told_beside_rays_without_light():
    """Slices without a shadow beside them are left out, and nothing is divided by their width."""
    scan = simulate_scan("lung", 24, 48, geometry="cone", photons=3e4, seed=3)
    values = scan.projections.copy()
    values[11, :, 14:20] = 60.0 + np.random.default_rng(0).normal(size=(48, 6))
    with np.errstate(divide="raise", invalid="raise"):
        found = answer(replace(scan, projections=values), "unit of length")
    assert 100 < found.values["density"] < 600

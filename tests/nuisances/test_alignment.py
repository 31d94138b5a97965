"""The scanner's geometry as a nuisance: what is fitted, its steps, its gauge and gate, and axes found again."""

import numpy as np
import pytest
import torch

from tomo_polysplat.kernels.project.autograd import project
from tomo_polysplat.nuisances.alignment import Alignment
from tomo_polysplat.render.renderer import detector_views
from tomo_polysplat.scan.as_told import seen_as_told
from tomo_polysplat.scan.moves import Scanner, moved_geometry
from tomo_polysplat.scan.view_geometry import Geometry


def orbit(beam="cone", views=21, arc=360.0, rows=23, columns=31, pixel=0.1):
    angle = np.deg2rad(arc) * np.arange(views) / views
    zero = np.zeros(views)
    ahead = np.stack([-np.sin(angle), np.cos(angle), zero], axis=1)
    u = pixel * np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
    v = np.tile([0.0, 0.0, pixel], (views, 1))
    corner = (4 * ahead if beam == "cone" else 0 * ahead) - (columns - 1) / 2 * u - (rows - 1) / 2 * v
    return Geometry(beam, -6 * ahead if beam == "cone" else ahead, corner, u, v, rows, columns)


def cloud(count=60):
    generator = torch.Generator().manual_seed(0)
    position = 0.8 * (2 * torch.rand((count, 3), generator=generator) - 1)
    scale = 0.08 + 0.1 * torch.rand((count, 3), generator=generator)
    return (
        position,
        scale,
        torch.randn((count, 4), generator=generator),
        torch.rand((1, count), generator=generator),
    )


def images(geometry, scene):
    return project(*scene, detector_views(geometry, False), kernel="numba", cutoff=4.0)[0][0]


def number(value):
    return torch.tensor(value, dtype=torch.float64)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_a_known_object_tells_where_the_scanner_is(beam):
    """Offset, roll, skew and shifts of all views from the rays of a cloud that does not move."""
    told, scene = orbit(beam), cloud()
    shifts = torch.from_numpy(np.random.default_rng(0).normal(0, 0.4, (21, 2)))
    alignment = Alignment(told, 1.0)
    assert set(alignment.names) >= {"u", "roll", "skew", "views"}
    alignment.values["views"] = shifts.clone()
    alignment.hold_gauge()
    true = {"u": number(1.5), "roll": number(2.0), "skew": number(-1.0), "views": alignment.values["views"]}
    measured = images(moved_geometry(Scanner(told), true), scene)
    alignment = Alignment(told, 1.0)
    views = detector_views(told, False)
    for step in range(90):
        chosen = np.arange(step % 3, 21, 3)
        vectors = alignment.vectors(chosen).requires_grad_()
        image, _ = project(*scene, views.select(chosen), kernel="numba", cutoff=4.0, vectors=vectors)
        (image[0] - measured[chosen]).abs().mean().backward()
        rate = 0.3 * 0.01 ** (step / 90)
        alignment.step(chosen, alignment.gradient(chosen, vectors.grad), rate)
        if step % 3 == 2:
            alignment.hold_gauge()
    assert float(alignment.values["u"]) == pytest.approx(1.5, abs=0.02)
    assert float(alignment.values["roll"]) == pytest.approx(2.0, abs=0.1)
    assert float(alignment.values["skew"]) == pytest.approx(-1.0, abs=0.1)
    assert (alignment.values["views"] - true["views"]).square().mean().sqrt() < 0.03
    if "tilt" in alignment.names:
        assert abs(float(alignment.values["tilt"])) < 1.0
    np.testing.assert_allclose(
        alignment.geometry().corner, moved_geometry(Scanner(told), true).corner, atol=0.02
    )


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_gradient_is_that_of_the_loss_by_the_values(beam):
    """In float64 through the reference kernel, by pixels joined by two, against finite differences."""
    told, chosen = orbit(beam, views=5, rows=6, columns=10, pixel=0.3), np.array([3, 1])
    scene = [t.double() for t in cloud(20)]
    alignment = Alignment(
        told, 1.0, names=("u", "v", "roll", "tilt", "slant", "skew", "views"), start={"u": 0.3}
    )
    alignment.values["views"] = torch.randn((5, 2), generator=torch.Generator().manual_seed(2)).double()
    joined = detector_views(told.binned(2), False).select(chosen)
    target = torch.randn((2, 3, 5), generator=torch.Generator().manual_seed(3)).double()

    def loss(vectors):
        image, _ = project(*scene, joined, kernel="reference", cutoff=9.0, vectors=vectors)
        return (image[0] * target).sum()

    vectors = alignment.vectors(chosen, 2, 2).requires_grad_()
    loss(vectors).backward()
    got = alignment.gradient(chosen, vectors.grad, 2, 2)
    h = 1e-4
    for name, value in alignment.values.items():
        kept, where = value.clone(), (3, 1) if name == "views" else ()
        ends = []
        for step in (h, -h, 2 * h, -2 * h):
            alignment.values[name] = kept.clone()
            alignment.values[name][where] += step
            ends.append(float(loss(alignment.vectors(chosen, 2, 2))))
        alignment.values[name] = kept
        difference = (8 * (ends[0] - ends[1]) - ends[2] + ends[3]) / (12 * h)
        assert float(got[name][where]) == pytest.approx(difference, rel=1e-6, abs=1e-8), name
    assert (got["views"][[0, 2, 4]] == 0).all()


def test_what_rays_cannot_tell_is_not_fitted_and_said():
    short = Alignment(orbit(views=21, arc=20.0), 1.0)
    assert "u" in short.left and "u not fitted: the object can take its place" in short.describe()
    parallel = Alignment(orbit("parallel"), 1.0)
    assert "tilt" not in parallel.names and "distance" not in parallel.names
    assert Alignment(orbit(), 1.0, names=("v",)).names == ("v",)


def test_a_scan_of_one_plane_stays_in_it():
    told = orbit(rows=1)
    alignment = Alignment(told, 1.0)
    assert told.planar and alignment.names == ("u", "views")
    views = detector_views(told, True)
    position, scale, rotation, weight = cloud(9)
    position[:, 2], scale[:, 2], rotation[:, 1:3] = 0.0, float("inf"), 0.0
    vectors = alignment.vectors(np.arange(21)).requires_grad_()
    scene = (position, scale, rotation, weight)
    image, _ = project(*scene, views, kernel="numba", cutoff=4.0, vectors=vectors)
    image.square().sum().backward()
    alignment.step(np.arange(21), alignment.gradient(np.arange(21), vectors.grad), 0.5)
    alignment.hold_gauge()
    assert (alignment.values["views"][:, 0] != 0).any() and alignment.values["views"][
        :, 1
    ].abs().max() < 1e-12
    assert alignment.geometry().planar


def test_an_unknown_move_is_refused():
    with pytest.raises(ValueError, match="align: expected 'usual' or names among u, v"):
        Alignment(orbit(), 1.0, names=("rol",))


def test_a_start_is_kept_where_it_is_not_fitted():
    alignment = Alignment(orbit(), 1.0, names=("roll",), start={"u": 2.0})
    gradient = alignment.gradient(np.arange(3), torch.ones((3, 4, 3)))
    alignment.step(np.arange(3), gradient, 0.1)
    assert float(alignment.values["u"]) == 2.0 and float(alignment.values["roll"]) != 0.0
    assert alignment.units == {"roll": "deg", "u": "px"}


def test_moves_held_and_views_not_chosen_stay():
    alignment = Alignment(orbit(), 1.0)
    chosen = np.array([2, 5])
    gradient = alignment.gradient(chosen, torch.ones((2, 4, 3)))
    alignment.step(chosen, gradient, 0.1, hold=("u",))
    assert float(alignment.values["u"]) == 0.0
    still = np.setdiff1d(np.arange(21), chosen)
    assert (alignment.values["views"][still] == 0).all() and (alignment.values["views"][chosen] != 0).all()
    # A step is about as long as asked for, and no angle goes beyond ten degrees.
    assert 0.03 < alignment.values["views"][chosen].abs().mean() < 0.3
    for _ in range(40):
        alignment.step(chosen, gradient, 5.0)
    assert abs(float(alignment.values["roll"])) == 10.0


def test_an_offset_of_all_views_is_the_detectors():
    alignment = Alignment(orbit(), 1.0)
    for hold, u in (((), 0.6), (("u",), 0.6)):
        alignment.values["views"] = torch.full((21, 2), 0.6 if not hold else 0.1, dtype=torch.float64)
        alignment.hold_gauge(hold)
        assert float(alignment.values["u"]) == pytest.approx(u, abs=1e-9)
        assert alignment.values["views"].abs().max() < 1e-9


def test_a_checkpoint_goes_on_with_the_same_values():
    first = Alignment(orbit(), 1.0, start={"u": 1.25})
    first.values["views"] += torch.randn((21, 2)).double()
    second = Alignment(orbit(), 1.0)
    second.restore(first.state())
    assert second.report() == first.report()


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_projections_as_the_told_geometry_would_have_seen_them(beam):
    told, scene = orbit(beam, views=5), cloud(30)
    values = {"u": number(1.6), "roll": number(3.0), "views": torch.randn((5, 2), dtype=torch.float64) * 0.5}
    seen = seen_as_told(images(moved_geometry(Scanner(told), values), scene), Scanner(told), values)
    expected = images(told, scene)
    away = images(moved_geometry(Scanner(told), values), scene) - expected
    inside = (slice(None), slice(4, -4), slice(4, -4))
    assert (seen - expected)[inside].norm() < 0.15 * away[inside].norm()
    same = seen_as_told(expected, Scanner(told), {})
    assert torch.allclose(same, expected, atol=1e-5)

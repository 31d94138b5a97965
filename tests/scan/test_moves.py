"""Moves of a scanner: what each does to where points fall, their derivatives, and what rays cannot tell of them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tomo_polysplat.scan.gauges import common_offset, effects, view_gauge, without_gauge
from tomo_polysplat.scan.moves import MOVES, Scanner, moved_geometry
from tomo_polysplat.scan.view_geometry import Geometry

WHOLE = [name for name in MOVES if name != "views"]


def orbit(beam="cone", views=9, arc=360.0, rows=7, columns=11, pixel=0.1):
    """Source 6 from the axis of rotation and detector 9 behind it, or parallel rays; the detector sees z upwards."""
    angle = np.deg2rad(arc) * np.arange(views) / views
    zero = np.zeros(views)
    ahead = np.stack([-np.sin(angle), np.cos(angle), zero], axis=1)
    u = pixel * np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
    v = np.tile([0.0, 0.0, 1.3 * pixel], (views, 1))
    middle = 9 * ahead if beam == "cone" else 0 * ahead
    corner = middle - (columns - 1) / 2 * u - (rows - 1) / 2 * v
    return Geometry(beam, -6 * ahead if beam == "cone" else ahead, corner, u, v, rows, columns)


def number(value):
    return torch.tensor(value, dtype=torch.float64)


def falls(geometry, point):
    """(views, 2) column and row from the detector's middle."""
    at = geometry.project_points(np.array([point], float))[:, 0]
    return at - [(geometry.columns - 1) / 2, (geometry.rows - 1) / 2]


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_without_moves_nothing_moves(beam):
    told = orbit(beam)
    same = moved_geometry(Scanner(told), {name: number(0.0) for name in WHOLE})
    for name in ("origin", "corner", "u", "v"):
        np.testing.assert_allclose(getattr(same, name), getattr(told, name), rtol=0, atol=1e-14)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_offsets_and_roll_in_closed_form(beam):
    """The detector moved by (a, b) pixels sees all the other way; rolled by t, in a picture turned by -t."""
    told, point = orbit(beam), (0.2, -0.1, 0.3)
    values = {"u": number(1.25), "v": number(-0.5), "views": torch.randn(9, 2).double()}
    shift = np.array([1.25, -0.5]) + values["views"].numpy()
    got = falls(moved_geometry(Scanner(told), values), point)
    np.testing.assert_allclose(got, falls(told, point) - shift, atol=1e-12)
    size, t = np.array([0.1, 0.13]), np.deg2rad(3.0)
    x, y = (falls(told, point) * size).T
    turned = np.stack([np.cos(t) * x + np.sin(t) * y, -np.sin(t) * x + np.cos(t) * y], axis=1) / size
    got = falls(moved_geometry(Scanner(told), {"roll": number(3.0)}), point)
    np.testing.assert_allclose(got, turned, atol=1e-12)


@pytest.mark.parametrize(("name", "step"), [("tilt", "v"), ("slant", "u")])
def test_a_tilted_detector_is_farther_away_at_its_far_end(name, step):
    told = orbit()
    moved = moved_geometry(Scanner(told), {name: number(5.0)})
    away = (told.centre - told.origin) / 15.0
    length = np.linalg.norm(getattr(told, step), axis=1)
    slope = np.einsum("vk,vk->v", getattr(moved, step), away) / length
    np.testing.assert_allclose(slope, np.sin(np.deg2rad(5.0)), atol=1e-12)
    np.testing.assert_allclose(moved.centre, told.centre, atol=1e-12)


def test_distance_magnifies_and_skew_leans_the_axis_away_from_the_source():
    told = orbit()
    farther = moved_geometry(Scanner(told), {"distance": number(4.0)})
    np.testing.assert_allclose(falls(farther, (0, 0, 0.3)), 1.04 * falls(told, (0, 0, 0.3)), atol=1e-12)
    skewed = moved_geometry(Scanner(told), {"skew": number(2.0)})
    np.testing.assert_allclose(falls(skewed, (0, 0, 0)), 0.0, atol=1e-12)
    # What is up on the axis is farther from the source then, by sin(2 degrees).
    depth = 6 + 0.5 * np.sin(np.deg2rad(2.0))
    row = 0.5 * np.cos(np.deg2rad(2.0)) * 15 / depth / 0.13
    np.testing.assert_allclose(falls(skewed, (0, 0, 0.5)), np.tile([0.0, row], (9, 1)), atol=1e-12)


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_gradients_of_all_moves(beam):
    scanner = Scanner(orbit(beam, views=3), np.array([0.1, 0.2, -0.1]))
    generator = torch.Generator().manual_seed(1)
    start = [torch.randn((), generator=generator, dtype=torch.float64) for _ in WHOLE]
    start.append(torch.randn((3, 2), generator=generator, dtype=torch.float64))
    inputs = [value.requires_grad_() for value in start]

    def vectors(*values):
        moved = scanner.moved(dict(zip([*WHOLE, "views"], values, strict=True)))
        return moved.vectors(scanner.cone)

    assert torch.autograd.gradcheck(vectors, inputs, eps=1e-5, atol=1e-8, rtol=1e-6)


def test_some_of_the_views_are_those_of_all():
    scanner = Scanner(orbit())
    values = {"roll": number(1.0), "views": torch.randn(9, 2).double()}
    for one, many in zip(scanner.moved(values, np.array([5, 2])), scanner.moved(values), strict=True):
        assert torch.equal(one, many[[5, 2]])


def test_points_fall_where_the_moved_geometry_says():
    scanner, points = Scanner(orbit()), torch.randn(5, 3).double()
    values = {"u": number(0.7), "skew": number(3.0), "slant": number(-4.0)}
    expected = moved_geometry(scanner, values).project_points(points.numpy())
    np.testing.assert_allclose(scanner.project(values, points).numpy(), expected, atol=1e-10)


@pytest.mark.parametrize("factor", [2, 3])
def test_joined_pixels_are_those_of_the_binned_geometry(factor):
    told = orbit(rows=6, columns=12)
    got = Scanner(told).moved({}).joined(factor, factor)
    expected = told.binned(factor)
    np.testing.assert_allclose(got.corner, expected.corner, atol=1e-14)
    np.testing.assert_allclose(got.u, expected.u, atol=1e-14)
    back = got.joined(1 / factor, 1 / factor)
    np.testing.assert_allclose(back.corner, told.corner, atol=1e-14)


def test_a_move_that_is_none_is_refused():
    with pytest.raises(ValueError, match="moves: expected names among"):
        Scanner(orbit()).moved({"yaw": number(1.0)})


def test_what_a_full_turn_tells_and_what_not():
    """An offset along the columns in full, one along the rows and the distance hardly: the object takes their place."""
    found = effects(Scanner(orbit(views=40)), WHOLE, 0.5)
    told = {name: effect.told for name, effect in found.items()}
    assert min(told[name] for name in ("u", "roll", "skew", "slant")) > 0.99
    assert max(told["v"], told["distance"]) < 0.06
    assert found["u"].pixels == pytest.approx(1.0, rel=1e-3)


def test_what_parallel_rays_and_a_short_arc_cannot_tell():
    half = effects(Scanner(orbit("parallel", views=40, arc=180.0)), ["u", "v", "distance"], 0.5)
    # Of a constant, 1 - 8 / pi^2 in square is left when the cosine and the sine of half a turn are taken out.
    assert half["u"].told == pytest.approx(np.sqrt(1 - 8 / np.pi**2), abs=0.01)
    assert half["v"].told < 1e-6 and half["distance"].told == 0.0
    assert effects(Scanner(orbit(views=21, arc=30.0)), ["u"], 0.5)["u"].told < 0.05


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_shifts_that_the_object_makes_are_gauge(beam):
    scanner = Scanner(orbit(beam, views=13))
    gauge = view_gauge(scanner)
    angle = 2 * np.pi * np.arange(13) / 13
    zero = np.zeros(13)
    for u, v in ((np.cos(angle), zero), (np.sin(angle), zero), (zero + 1, zero), (zero, zero + 1)):
        shifts = torch.from_numpy(np.stack([u, v], axis=1))
        assert without_gauge(shifts, gauge).abs().max() < 1e-12
    twice = torch.from_numpy(np.stack([np.cos(2 * angle), np.sin(angle)], axis=1))
    assert torch.allclose(without_gauge(twice, gauge), twice, atol=1e-12)


@pytest.mark.parametrize("arc", [180.0, 360.0])
def test_an_offset_is_told_from_a_move_of_the_object(arc):
    """In half a turn the sine has a mean, which is none of the detector's."""
    scanner = Scanner(orbit("parallel", views=40, arc=arc))
    angle = np.deg2rad(arc) * np.arange(40) / 40
    u = 0.7 + 0.5 * np.sin(angle) - 0.2 * np.cos(angle)
    shifts = torch.from_numpy(np.stack([u, 0 * u], axis=1))
    assert torch.allclose(common_offset(shifts, scanner), torch.tensor([0.7, 0.0]).double(), atol=1e-9)


def test_a_lift_that_is_all_but_an_offset_makes_none_of_millions_of_pixels():
    """Rounding tells the two apart: without a bound each gets the other's with a huge factor."""
    told, rng = orbit("cone", views=40), np.random.default_rng(0)
    shaken = replace(told, v=told.v * (1 + 1e-12 * rng.normal(size=(40, 1))))
    shifts = torch.from_numpy(rng.normal(0, 0.1, (40, 2)))
    assert common_offset(shifts, Scanner(shaken)).abs().max() < 0.2

"""Path lengths through single and nested solids, against closed forms and against brute force."""

import numpy as np
import pytest

from tomo_polysplat.simulate.chords import trace_view
from tomo_polysplat.simulate.phantom import Part, Phantom
from tomo_polysplat.simulate.shapes import box, cylinder, ellipsoid, rotation


def chord(shape, origin, direction, **bounds):
    """Path length of one ray, by way of a phantom of density 1."""
    phantom = Phantom([Part(shape, "water", 1.0)])
    return phantom.areal_density(np.array([origin], float), np.array([direction], float), **bounds)[0, 0]


@pytest.mark.parametrize("distance", [0.0, 0.3, 1.9, 1.999999])
@pytest.mark.parametrize("length", [1e-3, 1.0, 250.0])
def test_ball_chord(distance, length):
    got = chord(ellipsoid((1, 2, 3), 2.0), (1 - 50, 2 + distance, 3), (length, 0, 0))
    assert got == pytest.approx(2 * np.sqrt(4 - distance**2), rel=1e-9)


def test_ball_keeps_its_digits_from_far_away():
    # b^2 - ac would lose twelve of sixteen digits here.
    assert chord(ellipsoid((0, 0, 0), 1e-3), (-1e3, 0, 0), (1, 0, 0)) == pytest.approx(2e-3, rel=1e-9)


def test_turned_ellipsoid_chords():
    turn = rotation((1, -2, 0.5), 37.0)
    shape = ellipsoid((0.2, -0.1, 0.4), (0.5, 1.0, 2.0), turn)
    for axis, semi in enumerate((0.5, 1.0, 2.0)):
        direction = turn[:, axis]
        assert chord(shape, shape.centre - 9 * direction, direction) == pytest.approx(2 * semi, rel=1e-12)
    # Any other central chord: 2 / sqrt(d' A d) for the unit vector d.
    direction = np.array([0.6, 0.0, 0.8])
    quadric = turn @ np.diag([4.0, 1.0, 0.25]) @ turn.T
    expected = 2 / np.sqrt(direction @ quadric @ direction)
    assert chord(shape, shape.centre + 5 * direction, direction) == pytest.approx(expected, rel=1e-12)


def test_cylinder_chords():
    axis = np.array([1.0, 2.0, -0.5]) / np.linalg.norm([1.0, 2.0, -0.5])
    side = np.cross(axis, [0, 0, 1]) / np.linalg.norm(np.cross(axis, [0, 0, 1]))
    shape = cylinder((3, -1, 2), 0.5, 1.25, axis)
    assert chord(shape, shape.centre - 7 * axis + 0.49 * side, axis) == pytest.approx(2.5, rel=1e-12)
    assert chord(shape, shape.centre - 7 * side + 1.2 * axis, side) == pytest.approx(1.0, rel=1e-12)
    slanted = (axis + side) / np.sqrt(2)  # through the centre at 45 degrees: held by the wall, not the ends
    assert chord(shape, shape.centre - 7 * slanted, slanted) == pytest.approx(np.sqrt(2), rel=1e-12)
    # Entering through an end and leaving through the wall.
    start = shape.centre + 1.25 * axis - 5 * slanted
    assert chord(shape, start, slanted) == pytest.approx(np.sqrt(2) * 0.5, rel=1e-12)
    assert chord(shape, shape.centre - 7 * side + 1.3 * axis, side) == 0.0


def test_elliptic_cylinder_has_x_first():
    shape = cylinder((0, 0, 0), (2.0, 0.5), 1.0)
    assert chord(shape, (-9, 0, 0), (1, 0, 0)) == pytest.approx(4.0)
    assert chord(shape, (0, -9, 0), (0, 1, 0)) == pytest.approx(1.0)


def test_box_chords():
    turn = rotation((0, 0, 1), 30.0)
    shape = box((1, 1, 1), (1.0, 2.0, 3.0), turn)
    for axis, half in enumerate((1.0, 2.0, 3.0)):
        assert chord(shape, shape.centre - 9 * turn[:, axis], turn[:, axis]) == pytest.approx(2 * half)
    diagonal = turn @ np.array([1.0, 2.0, 3.0])
    assert chord(shape, shape.centre - 3 * diagonal, diagonal) == pytest.approx(2 * np.sqrt(14))


@pytest.mark.parametrize(
    "shape",
    [ellipsoid((0, 0, 0), 1.0), cylinder((0, 0, 0), 1.0, 1.0), box((0, 0, 0), 1.0)],
    ids=["ball", "cylinder", "box"],
)
def test_misses_and_tangents_are_empty(shape):
    assert chord(shape, (-5, 1.0 + 1e-9, 0), (1, 0, 0)) == 0.0
    assert chord(shape, (-5, 4, 0), (1, 0.1, 0)) == 0.0
    assert chord(shape, (-5, 1.0, 0), (1, 0, 0)) == 0.0


def test_rays_that_start_or_stop_inside():
    ball = ellipsoid((0, 0, 0), 1.0)
    assert chord(ball, (0.5, 0, 0), (1, 0, 0), start=0.0) == pytest.approx(0.5)
    assert chord(ball, (-5, 0, 0), (4.25, 0, 0), start=0.0, stop=1.0) == pytest.approx(0.25)
    assert chord(ball, (3, 0, 0), (1, 0, 0), start=0.0) == 0.0


def nested_phantom(seed, count=12):
    """Overlapping solids of every kind, each of its own material and a density that tells them apart."""
    generator = np.random.default_rng(seed)
    parts = []
    for n in range(count):
        turn = rotation(generator.standard_normal(3), generator.uniform(0, 360))
        centre, semi = generator.uniform(-0.7, 0.7, 3), generator.uniform(0.2, 0.9, 3)
        kind = n % 3
        shape = (
            ellipsoid(centre, semi, turn)
            if kind == 0
            else box(centre, semi, turn)
            if kind == 1
            else cylinder(centre, semi[0], semi[2], turn[:, 2])
        )
        parts.append(Part(shape, f"material {n}", 1.0 + n))
    return Phantom(parts)


@pytest.mark.parametrize("seed", range(4))
def test_nesting_against_samples_along_the_ray(seed):
    phantom = nested_phantom(seed)
    generator = np.random.default_rng(100 + seed)
    origins = generator.uniform(-1, 1, (20, 3)) - (3, 0, 0)
    directions = np.array([6.0, 0, 0]) + generator.uniform(-1, 1, (20, 3))
    samples = 40_000
    at = (np.arange(samples) + 0.5) / samples
    points = origins[:, None] + at[:, None] * directions[:, None]
    top = np.full(points.shape[:2], -1)
    for n, part in enumerate(phantom.parts):
        top[part.shape.contains(points)] = n
    length = np.linalg.norm(directions, axis=1)
    expected = np.stack(
        [(top == n).mean(axis=1) * length * (1.0 + n) for n in range(len(phantom.parts))], axis=1
    )
    got = phantom.areal_density(origins, directions, start=0.0, stop=1.0)
    assert (expected > 0).sum() > 30
    # Each of the few ends of an interval is off by at most one sample.
    np.testing.assert_allclose(got, expected, atol=12 * 8 * length.max() / samples)


def test_a_hole_takes_away_and_a_later_part_fills_it():
    parts = [
        Part(ellipsoid((0, 0, 0), 2.0), "water", 1.0),
        Part(ellipsoid((0, 0, 0), 1.0), "water", 0.0),
        Part(ellipsoid((0, 0, 0), 0.5), "iron", 7.87),
    ]
    got = Phantom(parts).areal_density(np.array([[-9.0, 0, 0]]), np.array([[1.0, 0, 0]]))
    np.testing.assert_allclose(got, [[2.0, 7.87]], rtol=1e-12)
    buried = Phantom(parts[::-1]).areal_density(np.array([[-9.0, 0, 0]]), np.array([[1.0, 0, 0]]))
    np.testing.assert_allclose(buried, [[0.0, 4.0]], rtol=1e-12)


@pytest.mark.parametrize("cone", [True, False])
@pytest.mark.parametrize("rows, columns", [(1, 37), (19, 1), (35, 33)])
def test_tiles_leave_out_no_solid(cone, rows, columns):
    """A view, culled by tiles, equals its rays traced one by one."""
    phantom = nested_phantom(9, count=30)
    u, v = np.array([3.0 / 35, 0.01, 0.0]), np.array([0.005, 0.0, 2.8 / 33])
    corner = np.array([0.1, 4.0, 0.1]) - (columns - 1) / 2 * u - (rows - 1) / 2 * v
    beam = np.array([0.3, -6.0, 0.1]) if cone else np.array([0.1, 1.0, 0.05])
    out = np.zeros((rows, columns, len(phantom.materials)))
    trace_view(cone, beam, corner, u, v, phantom.solids(), out)
    pixels = (corner + np.arange(rows)[:, None, None] * v + np.arange(columns)[None, :, None] * u).reshape(
        -1, 3
    )
    if cone:
        single = phantom.areal_density(
            np.broadcast_to(beam, pixels.shape), pixels - beam, start=0.0, stop=1.0
        )
    else:
        single = phantom.areal_density(pixels, np.broadcast_to(beam, pixels.shape))
    assert single.max() > 0
    np.testing.assert_allclose(out.reshape(single.shape), single, atol=1e-12)


@pytest.mark.parametrize(
    "shape", [ellipsoid((0.1, 0, 0), (0.7, 0.3, 0.5), rotation((1, 1, 0), 50)), box((0, 0.1, 0), 0.4)]
)
def test_parallel_projection_integrates_to_the_mass(shape):
    phantom = Phantom([Part(shape, "water", 1.3)])
    n, side = 300, 2.0
    pixel = side / n
    out = np.zeros((n, n, 1))
    corner = np.array([-(n - 1) / 2 * pixel, -5.0, -(n - 1) / 2 * pixel])
    trace_view(
        False,
        np.array([0.0, 1.0, 0.0]),
        corner,
        np.array([pixel, 0, 0]),
        np.array([0, 0, pixel]),
        phantom.solids(),
        out,
    )
    assert out.sum() * pixel**2 == pytest.approx(1.3 * shape.volume, rel=2e-3)


def test_bounds_of_a_shape_hold_it_tightly():
    generator = np.random.default_rng(3)
    for part in nested_phantom(5).parts:
        shape = part.shape
        points = shape.centre + generator.uniform(-1, 1, (40_000, 3)) * shape.radius
        inside = points[shape.contains(points)] - shape.centre
        assert np.all(np.abs(inside) <= shape.half_extent)
        assert np.all(shape.half_extent <= shape.radius * (1 + 1e-12))
        assert np.all(np.abs(inside).max(axis=0) > 0.6 * shape.half_extent)


@pytest.mark.parametrize(
    "build, words",
    [
        (lambda: ellipsoid((0, 0), 1.0), "centre"),
        (lambda: box((0, 0, 0), (1.0, -1.0, 1.0)), "above 0"),
        (lambda: cylinder((0, 0, 0), 1.0, 1.0, (0, 0, 0)), "direction"),
        (lambda: box((0, 0, 0), 1.0, np.ones((3, 3))), "rotation"),
        (lambda: Phantom([]), "at least one part"),
        (lambda: Phantom([Part(ellipsoid((0, 0, 0), 1.0), "water", -1.0)]), "density"),
    ],
)
def test_nonsense_is_refused(build, words):
    with pytest.raises(ValueError, match=words):
        build()

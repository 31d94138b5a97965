"""The reference projection against integrals worked out another way, and its derivatives."""

import math

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from splat_scenes import cone_views, gaussians, parallel_views, planar_views, run_project

from tomo_polysplat.kernels.project import reference
from tomo_polysplat.kernels.views import DetectorViews


def _axes_as_columns(quaternion):
    w, x, y, z = np.asarray(quaternion)
    return Rotation.from_quat([x, y, z, w]).as_matrix()


def _rays(views, view):
    """Points on the rays of one view and their unit directions, (rows, columns, 3), from the definitions."""
    u, v, d = views.matrix[view].T
    row, column = np.mgrid[: views.rows, : views.columns][..., None]
    steps = column * u + row * v
    if views.cone:
        ray = d + steps
        return np.broadcast_to(views.origin[view], ray.shape), ray / np.linalg.norm(
            ray, axis=-1, keepdims=True
        )
    return views.origin[view] + steps, np.broadcast_to(d / np.linalg.norm(d), steps.shape)


def _line_integrals(scene, views, view):
    """Trapezoidal rule along every ray; for a function that decays like a Gaussian its error is below rounding."""
    position, scale, rotation, weight = (t.numpy() for t in scene)
    points, directions = _rays(views, view)
    image = np.zeros((len(weight), views.rows, views.columns))
    for n in range(len(position)):
        axes = _axes_as_columns(rotation[n])
        middle = ((position[n] - points) * directions).sum(axis=-1)
        step = scale[n].min() / 4
        reach = 10 * scale[n].max()
        for t in np.arange(-reach, reach, step):
            x = points + (middle + t)[..., None] * directions - position[n]
            local = (x @ axes) / scale[n]
            image += weight[:, n, None, None] * step * np.exp(-0.5 * (local**2).sum(axis=-1))
    return image


@pytest.mark.parametrize("make_views", [cone_views, parallel_views])
def test_line_integral_is_the_quadrature_along_the_ray(make_views):
    views, scene = make_views(2, 9, 13, pixel=(0.3, 0.25)), gaussians(3, size=0.3)
    image, skipped = reference.project(*scene, views, cutoff=15.0)
    assert skipped == 0
    for view in range(2):
        expected = _line_integrals(scene, views, view)
        np.testing.assert_allclose(image[:, view].numpy(), expected, rtol=1e-9, atol=1e-12 * expected.max())


@pytest.mark.parametrize("cone", [True, False])
def test_planar_scan_is_the_two_dimensional_integral(cone):
    """A Gaussian very long across the plane has the line integrals of an infinitely long one."""
    views, scene = planar_views(cone), gaussians(7, planar=True)
    planar, _ = reference.project(*scene, views, cutoff=4.0)
    scene[1][:, 2] = 1e4
    long = DetectorViews(cone, views.origin, views.matrix, 1, views.columns)
    np.testing.assert_allclose(planar, reference.project(*scene, long, cutoff=4.0)[0], rtol=1e-6, atol=1e-12)


def test_a_far_source_gives_parallel_rays():
    parallel, scene = parallel_views(), gaussians(11)
    distance = 1e7
    direction = parallel.matrix[:, :, 2] / np.linalg.norm(parallel.matrix[:, :, 2], axis=1, keepdims=True)
    matrix = parallel.matrix.copy()
    matrix[:, :, 2] = distance * direction
    cone = DetectorViews(
        True, parallel.origin - distance * direction, matrix, parallel.rows, parallel.columns
    )
    # Cut beyond what matters, so that no pixel is in one image and cut from the other.
    expected = reference.project(*scene, parallel, cutoff=9.0)[0]
    image, skipped = reference.project(*scene, cone, cutoff=9.0)
    assert skipped == 0
    np.testing.assert_allclose(image, expected, atol=1e-5 * float(expected.max()))


def test_sum_over_a_parallel_view_is_the_mass(fast):
    """Cut at c deviations, a fraction 1 - exp(-c^2 / 2) of a projected Gaussian is left, whatever its shape."""
    views, scene = parallel_views(3, 161, 151, pixel=(0.025, 0.03)), gaussians(5, size=0.12)
    u, v, d = (views.matrix[:, :, k] for k in range(3))
    area = np.abs((np.cross(u, v) * d).sum(axis=1)) / np.linalg.norm(d, axis=1)
    for kernel, device in (("reference", "cpu"), fast):
        image = run_project(scene, views, kernel, device)[0][0].double()
        mass = (2 * math.pi) ** 1.5 * (scene[3] * scene[1].prod(dim=1)).sum(dim=1) * (1 - math.exp(-4.5))
        sums = image.sum(dim=(2, 3)).numpy() * area
        np.testing.assert_allclose(sums, np.broadcast_to(mass[:, None], sums.shape), rtol=2e-3)


def test_sum_over_a_cone_view_is_the_solid_angle_integral(fast):
    """Line integrals over all directions from the source sum to the integral of density / distance^2."""
    views, scene = cone_views(2, 101, 111, distance=3.0, pixel=(0.05, 0.05)), gaussians(3, size=0.2)
    scene[0] *= 0.4
    nodes, weights = np.polynomial.hermite_e.hermegauss(24)
    grid = np.stack(np.meshgrid(nodes, nodes, nodes), axis=-1).reshape(-1, 3)
    grid_weight = np.prod(np.stack(np.meshgrid(weights, weights, weights), axis=-1).reshape(-1, 3), axis=1)
    for kernel, device in (("reference", "cpu"), fast):
        image = run_project(scene, views, kernel, device, cutoff=6.0)[0][0].double().numpy()
        for view in range(2):
            u, v, d = views.matrix[view].T
            row, column = np.mgrid[: views.rows, : views.columns][..., None]
            length = np.linalg.norm(d + column * u + row * v, axis=-1)
            solid_angle = abs(np.cross(u, v) @ d) / length**3
            expected = np.zeros(3)
            for n in range(3):
                points = scene[0][n].numpy() + (grid * scene[1][n].numpy()) @ _axes_as_columns(scene[2][n]).T
                distance2 = ((points - views.origin[view]) ** 2).sum(axis=1)
                integral = (grid_weight / distance2).sum() * float(scene[1][n].prod())
                expected += scene[3][:, n].numpy() * integral
            np.testing.assert_allclose((image[:, view] * solid_angle).sum(axis=(1, 2)), expected, rtol=1e-4)


def test_brightest_pixel_is_where_the_centre_projects():
    """The oracle is the definition: the ray through pixel (row, column) meets the Gaussian's centre."""
    views = cone_views(3)
    for view in range(3):
        u, v, d = views.matrix[view].T
        point = views.origin[view] + 0.6 * (d + 17 * u + 8 * v)
        scene = gaussians(1, size=0.02)
        scene[0] = torch.as_tensor(point)[None]
        image, _ = reference.project(*scene, views.select([view]), cutoff=3.0)
        assert np.unravel_index(int(image[0, 0].argmax()), (views.rows, views.columns)) == (8, 17)


@pytest.mark.parametrize("make_views", [cone_views, parallel_views])
def test_moving_scanner_and_gaussians_together_changes_nothing(make_views):
    views, scene = make_views(), gaussians(11)
    turn, shift = Rotation.from_euler("xyz", [0.3, -0.7, 1.1]), np.array([0.4, -2.0, 1.3])
    moved = DetectorViews(
        views.cone,
        turn.apply(views.origin) + shift,
        turn.as_matrix() @ views.matrix,
        views.rows,
        views.columns,
    )
    rotation = turn * Rotation.from_quat(scene[2].numpy()[:, [1, 2, 3, 0]])
    other = [
        torch.as_tensor(turn.apply(scene[0].numpy()) + shift),
        scene[1],
        torch.as_tensor(rotation.as_quat()[:, [3, 0, 1, 2]]),
        scene[3],
    ]
    expected = reference.project(*scene, views, cutoff=3.0)[0]
    np.testing.assert_allclose(
        reference.project(*other, moved, cutoff=3.0)[0], expected, rtol=1e-8, atol=1e-14
    )


@pytest.mark.parametrize(
    "views",
    [
        cone_views(2, 3, 5, pixel=(0.5, 0.4)),
        parallel_views(2, 3, 5, pixel=(0.4, 0.3)),
        planar_views(True, 2, 9),
    ],
    ids=["cone", "parallel", "fan"],
)
def test_derivatives_of_the_reference(views):
    # The cut makes steps of exp(-18) of the peak, below the differences' own error.
    position, scale, rotation, weight = gaussians(2, channels=2, size=0.4, planar=views.planar)
    leaves = [t.requires_grad_() for t in (position, scale, rotation, weight)]
    if views.planar:
        scale = scale.detach()[:, :2].requires_grad_()
        leaves[1] = scale

    def image(p, s, q, w):
        if views.planar:
            s = torch.cat([s, s.new_full((len(s), 1), math.inf)], dim=1)
        return reference.project(p, s, q, w, views, 6.0)[0]

    assert torch.autograd.gradcheck(image, leaves)


def test_a_round_gaussian_has_no_gradient_of_its_rotation(fast):
    """On the CPU to the rounding of float64: of what rounding leaves Adam makes full steps."""
    scene = gaussians(7)
    scene[1][:] = 0.1
    for kernel, device in (("reference", "cpu"), fast):
        results, _ = run_project(scene, cone_views(), kernel, device)
        least = 1e-5 if device == "cuda" else 1e-12
        assert results[3].abs().max() < least * results[2].abs().max()

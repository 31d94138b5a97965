"""Projection and voxelisation by the Triton kernels against the reference: every geometry, size and channel."""

from unittest import mock

import torch
from splat_scenes import (
    as_float32,
    assert_close,
    cone_views,
    gaussians,
    parallel_views,
    planar_views,
    run_project,
    run_voxelise,
    vector_gradient,
    voxel_box,
)
from triton_case import case

from tomo_polysplat.kernels import portions
from tomo_polysplat.kernels.project.autograd import project


def _compare(scene, views, device, cutoff=3.0, **tolerance):
    expected, skipped = run_project(scene, views, cutoff=cutoff)
    got, also_skipped = run_project(scene, views, "triton", device, cutoff)
    assert skipped == also_skipped
    if views.planar:  # The scale of the missing dimension is infinite and has no gradient.
        expected[2], got[2] = expected[2][:, :2], got[2][:, :2]
    assert_close(got, expected, **tolerance)


def _compare_volumes(scene, box, device, cutoff=3.0):
    expected = run_voxelise(scene, box, cutoff=cutoff)
    got = run_voxelise(scene, box, "triton", device, cutoff)
    if torch.isinf(
        scene[1]
    ).any():  # The compiled kernels do not follow a two-dimensional Gaussian out of its plane.
        for results in (expected, got):
            results[2], results[3] = results[2][:, :2], results[3][:, [0, 3]]
    assert_close(got, expected)


@case
def cone_beam_tilted_detector_three_channels(device):
    """More Gaussians than a group of neighbours holds, and tiles that stick out of the detector."""
    _compare(as_float32(gaussians(37)), cone_views(2, 11, 21, pixel=(0.2, 0.25)), device)


@case
def a_large_cloud_portion_by_portion(device):
    """Without gradients; both a cone and a slice."""
    for scene, views in (
        (as_float32(gaussians(9)), cone_views(2, 9, 13)),
        (as_float32(gaussians(5, planar=True)), planar_views(True, 2, 13)),
    ):
        whole, _ = project(*(t.to(device, torch.float32) for t in scene), views, kernel="triton", cutoff=3.0)
        with mock.patch.object(portions, "FOOTPRINTS", 8), mock.patch.object(portions, "_WHOLE", 4):
            parted, _ = project(
                *(t.to(device, torch.float32) for t in scene), views, kernel="triton", cutoff=3.0
            )
        torch.testing.assert_close(parted, whole, rtol=1e-6, atol=1e-6)


@case
def cone_beam_one_channel(device):
    _compare(as_float32(gaussians(9, channels=1)), cone_views(1, 9, 33), device)


@case
def two_and_four_channels(device):
    for channels in (2, 4):
        _compare(as_float32(gaussians(3, channels=channels)), cone_views(1, 9, 7, pixel=(0.4, 0.3)), device)


@case
def parallel_beam_skewed_detector(device):
    _compare(as_float32(gaussians(9)), parallel_views(2, 7, 31, pixel=(0.09, 0.2)), device)


@case
def parallel_beam_one_channel(device):
    _compare(as_float32(gaussians(5, channels=1)), parallel_views(1, 17, 9, pixel=(0.2, 0.1)), device)


@case
def two_dimensional_scans(device):
    for cone in (True, False):
        for channels in (1, 3):
            scene = as_float32(gaussians(7, planar=True, channels=channels))
            _compare(scene, planar_views(cone, 2, 41), device)


@case
def one_gaussian_covers_the_detector(device):
    scene = as_float32(gaussians(1, seed=2))
    scene[0] *= 0.1
    scene[1] = torch.tensor([[1.1, 1.2, 1.3]], dtype=torch.float64)
    for views in (cone_views(1, 13, 19), parallel_views(1, 13, 19)):
        assert (run_project(scene, views)[0][0] > 0).all()
        _compare(scene, views, device)


@case
def many_gaussians_on_one_pixel(device):
    """Sums of many alike terms; on a GPU as many as a dense scene has under one ray."""
    count = 40 if device == "cpu" else 5000
    scene = as_float32(gaussians(count, size=0.1, channels=1))
    scene[0] = as_float32([0.01 * scene[0]])[0]
    _compare(scene, cone_views(1, 5, 5, tilt=0.0, pixel=(0.3, 0.3)), device)


@case
def needles(device):
    scene = gaussians(17, seed=3)
    scene[1] = torch.tensor([0.6, 6e-3, 6e-3], dtype=torch.float64).expand(17, 3)
    _compare(as_float32(scene), cone_views(1, 31, 33), device, cutoff=4.5, image=1e-4, gradient=1e-3)


@case
def gaussians_across_the_source_plane_are_skipped_and_counted(device):
    scene = as_float32(gaussians(40, seed=5, size=0.15))
    scene[0] *= 2.0
    views = cone_views(2, 9, 11, distance=1.0, pixel=(0.3, 0.3))
    assert 10 < run_project(scene, views)[1] < 70
    _compare(scene, views, device, image=1e-4, gradient=1e-3)


@case
def nothing_to_project(device):
    results, skipped = run_project(gaussians(0), cone_views(1, 5, 7), "triton", device)
    assert skipped == 0
    assert results[0].shape == (3, 1, 5, 7)
    beside = as_float32(gaussians(3))
    beside[0][:, 2] += 50.0
    results += run_project(beside, parallel_views(1, 5, 7), "triton", device)[0]
    assert all((t == 0).all() for t in results)


@case
def order_of_the_list_does_not_change_the_sums(device):
    from tomo_polysplat.kernels.spatial_order import spatial_order

    scene, views = as_float32(gaussians(40)), parallel_views(1, 9, 17)
    order = spatial_order(scene[0])
    assert sorted(order.tolist()) == list(range(40)) != order.tolist()
    plain, _ = run_project(scene, views, "triton", device)
    sorted_, _ = run_project([*(t[order] for t in scene[:3]), scene[3][:, order]], views, "triton", device)
    torch.testing.assert_close(plain[0], sorted_[0], rtol=1e-5, atol=1e-6)
    for k in range(1, 4):
        scale = float(plain[k].abs().max())
        torch.testing.assert_close(plain[k][order], sorted_[k], rtol=1e-4, atol=1e-4 * scale)


@case
def the_same_every_time(device):
    scene = as_float32(gaussians(9 if device == "cpu" else 3000))
    views, box = cone_views(1, 9, 17), voxel_box((3, 5, 9))
    for run, grid in ((lambda *a: run_project(*a)[0], views), (run_voxelise, box)):
        first, second = (run(scene, grid, "triton", device) for _ in range(2))
        # The image is added up atomically, in any order. Its cotangent is fixed, so the gradients share no sum.
        torch.testing.assert_close(first[0], second[0], rtol=1e-5, atol=1e-6 * float(first[0].abs().max()))
        assert all(torch.equal(a, b) for a, b in zip(first[1:], second[1:], strict=True))


@case
def volume_with_odd_sides(device):
    _compare_volumes(as_float32(gaussians(37)), voxel_box((5, 7, 11), (0.2, 0.3, 0.4)), device)


@case
def volume_of_one_channel(device):
    scene, box = as_float32(gaussians(9, channels=1)), voxel_box((6, 4, 9), (0.2, 0.4, 0.3))
    _compare_volumes(scene, box, device, cutoff=4.2)


@case
def volume_of_two_and_four_channels(device):
    for channels in (2, 4):
        scene = as_float32(gaussians(3, channels=channels))
        _compare_volumes(scene, voxel_box((4, 5, 6), (0.3, 0.4, 0.5)), device)


@case
def slices_of_two_dimensional_gaussians(device):
    _compare_volumes(as_float32(gaussians(7, planar=True)), voxel_box((2, 13, 11), (0.15, 0.15, 0.1)), device)


@case
def one_gaussian_fills_the_volume(device):
    _compare_volumes(as_float32(gaussians(1, size=30.0)), voxel_box((3, 5, 9)), device)


@case
def nothing_to_voxelise(device):
    results = run_voxelise(gaussians(0), voxel_box((2, 3, 4)), "triton", device)
    assert results[0].shape == (3, 2, 3, 4)
    outside = as_float32(gaussians(3))
    outside[0][:, 1] += 40.0
    results += run_voxelise(outside, voxel_box((2, 3, 4)), "triton", device)
    assert all((t == 0).all() for t in results)


@case
def wrong_inputs_are_refused(device):
    from tomo_polysplat.kernels.project.triton_kernel import project
    from tomo_polysplat.kernels.voxelise.triton_kernel import voxelise

    five_channels = [t.float() for t in gaussians(2, channels=5)]
    for scene, name in ((gaussians(2), "position"), (five_channels, "weight")):
        for operation, where in ((project, cone_views(1)), (voxelise, voxel_box())):
            try:
                operation(*(t.to(device) for t in scene), where, 3.0)
            except ValueError as problem:
                assert name in str(problem)
            else:
                raise AssertionError(f"{operation.__name__} took a wrong {name}")


@case
def gradients_lie_by_pairs_of_rows_and_zeros_follow(device):
    """Rows and footprints are read past their ends."""
    # Here, as the names of the cases are read where there is no Triton, too.
    from tomo_polysplat.kernels.project import triton_image as layout

    odd, flat = cone_views(2, 5, 7), planar_views(True, 2, 7)
    for channels, views in ((1, odd), (3, odd), (2, flat)):
        rows, columns, wide = views.rows, views.columns, layout.spread(channels)
        table = views.table(torch.device(device))
        grad = torch.rand((channels, 2, rows, columns), device=device)
        pixels = layout.lay_out_gradient(grad, table, views).view(-1, wide)
        factor = layout.finish_image(
            torch.ones((2, rows, columns, wide), device=device), table, channels, views
        )
        down, (room, beyond) = layout.folded(views), layout.gradient_room(views)
        assert len(pixels) == 2 * room + beyond and beyond >= down * (columns + 32)
        pairs = pixels[: 2 * room].view(2, -1, columns, down, wide)
        laid = pairs.transpose(2, 3).reshape(2, -1, columns, wide)
        assert torch.allclose(laid[:, :rows, :, :channels].movedim(-1, 0), grad * factor)
        assert not laid[:, rows:].any() and not laid[..., channels:].any() and not pixels[2 * room :].any()


@case
def gradient_by_the_vectors_of_the_views(device):
    """Of more Gaussians than a program takes, one of them beside the detector, another behind the source."""
    for views in (cone_views(2, 7, 9, pixel=(0.3, 0.3)), parallel_views(2, 7, 9, pixel=(0.3, 0.3))):
        scene = gaussians(70)
        scene[0][3, 2] += 50.0
        scene[0][5] = 3 * torch.as_tensor(views.origin[0])
        scene = as_float32(scene)
        expected, got = vector_gradient(scene, views), vector_gradient(scene, views, "triton", device)
        assert torch.isfinite(got).all()
        assert (got - expected).norm(dim=(0, 2)).div(expected.norm(dim=(0, 2))).max() < 1e-5

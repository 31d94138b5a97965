"""Voxelised Gaussians: closed forms of the reference, and the compiled versions against it."""

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from splat_scenes import (
    as_float32,
    assert_close,
    gaussians,
    random_like,
    run_project,
    run_voxelise,
    voxel_box,
)

from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.kernels.voxelise import reference
from tomo_polysplat.kernels.voxelise.box import VoxelBox

BOXES = {
    "odd": voxel_box(),
    "one_slice": voxel_box((1, 31, 47), (0.05, 0.07, 0.3)),
    "wide": voxel_box((3, 5, 123), (0.02, 0.3, 0.4)),
    "tall": voxel_box((63, 7, 1), (0.5, 0.3, 0.03)),
}


def test_value_at_a_voxel_is_the_gaussian_there():
    """Against the covariance matrix, inverted numerically."""
    scene, box = gaussians(5, size=0.4), voxel_box()
    volume = reference.voxelise(*scene, box, cutoff=30.0).numpy()
    for iz, iy, ix in ((0, 0, 0), (5, 7, 8), (10, 13, 2)):
        x = box.first + np.array([ix, iy, iz]) * box.spacing
        expected = np.zeros(3)
        for p, s, q, w in zip(*(t.numpy() for t in scene[:3]), scene[3].numpy().T, strict=True):
            axes = Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix()
            covariance = axes @ np.diag(s**2) @ axes.T
            expected += w * math.exp(-0.5 * (x - p) @ np.linalg.inv(covariance) @ (x - p))
        np.testing.assert_allclose(volume[:, iz, iy, ix], expected, rtol=1e-10)


def test_sum_over_the_voxels_is_the_mass(fast):
    scene, box = as_float32(gaussians(9, size=0.12)), voxel_box((71, 72, 73), (0.04, 0.04, 0.04))
    scene[0] *= 0.8
    mass = (2 * math.pi) ** 1.5 * (scene[3] * scene[1].prod(dim=1)).sum(dim=1)
    for kernel, device in (("reference", "cpu"), fast):
        volume = run_voxelise(scene, box, kernel, device, cutoff=5.0)[0].double()
        torch.testing.assert_close(volume.sum(dim=(1, 2, 3)) * 0.04**3, mass, rtol=1e-4, atol=0.0)


def test_sum_along_an_axis_is_the_parallel_projection(fast):
    """Two operations, one Gaussian: columns of voxels along y against rays along y through their centres."""
    scene, box = as_float32(gaussians(9, size=0.12)), voxel_box((35, 140, 37), (0.07, 0.025, 0.08))
    scene[0] *= 0.8
    matrix = np.stack([[box.spacing[0], 0, 0], [0, 0, box.spacing[2]], [0, 1.0, 0]], axis=1)[None]
    views = DetectorViews(False, box.first[None], matrix, box.shape[0], box.shape[2])
    for kernel, device in (("reference", "cpu"), fast):
        volume = run_voxelise(scene, box, kernel, device, cutoff=6.0)[0].double()
        image = run_project(scene, views, kernel, device, cutoff=6.0)[0][0][:, 0].double()
        sums = volume.sum(dim=2) * box.spacing[1]
        torch.testing.assert_close(sums, image, rtol=1e-4, atol=1e-5 * float(image.max()))


@pytest.mark.parametrize("planar", [False, True])
def test_derivatives_of_the_reference(planar):
    scene = gaussians(2, channels=2, size=0.4, planar=planar)
    box = voxel_box((1, 4, 5) if planar else (3, 4, 5), (0.4, 0.5, 0.6))
    scale = scene[1][:, :2] if planar else scene[1]
    leaves = [t.clone().requires_grad_() for t in (scene[0], scale, *scene[2:])]

    def volume(p, s, q, w):
        if planar:
            s = torch.cat([s, s.new_full((len(s), 1), math.inf)], dim=1)
        return reference.voxelise(p, s, q, w, box, 6.5)

    assert torch.autograd.gradcheck(volume, leaves)


@pytest.mark.parametrize("name", BOXES)
@pytest.mark.parametrize("channels", [1, 3])
def test_volume_and_gradients_match_the_reference(name, channels, fast, poison_empty):
    scene = as_float32(gaussians(61, channels=channels))
    assert_close(run_voxelise(scene, BOXES[name], *fast), run_voxelise(scene, BOXES[name]))


@pytest.mark.parametrize("size", [0.05, 0.4, 2.0])
@pytest.mark.parametrize("cutoff", [1.0, 3.3682, 12.0, 40.0])
def test_sizes_and_cutoffs(size, cutoff, fast):
    scene = as_float32(gaussians(31, seed=1, size=size))
    box = voxel_box((13, 15, 17), (0.12, 0.12, 0.12))
    assert_close(run_voxelise(scene, box, *fast, cutoff=cutoff), run_voxelise(scene, box, cutoff=cutoff))


@pytest.mark.parametrize("thin", [[1.0, 1e-3, 1e-3], [1.0, 1.0, 1e-3]], ids=["needle", "pancake"])
def test_aspect_ratio_of_a_thousand(thin, fast):
    scene = gaussians(400, seed=3)
    scene[1] = torch.tensor(thin, dtype=torch.float64).expand(400, 3)
    # Needles hit few voxel centres, so some are put right through one.
    box = voxel_box()
    scene[0][:9] = torch.as_tensor(box.first + box.spacing * np.array([8, 7, 5]))
    scene = as_float32(scene)
    expected, got = run_voxelise(scene, box, cutoff=5.0), run_voxelise(scene, box, *fast, cutoff=5.0)
    assert_close(got, expected, image=3e-4, gradient=1e-3)


@pytest.mark.parametrize("slices", [1, 3])
def test_two_dimensional_gaussians_are_alike_in_every_slice(slices, fast):
    scene = as_float32(gaussians(31, planar=True))
    box = voxel_box((slices, 31, 33), (0.06, 0.07, 0.1))
    expected, got = run_voxelise(scene, box), run_voxelise(scene, box, *fast)
    assert torch.equal(got[0][:, 0], got[0][:, -1])
    # In the plane only: the compiled kernels do not follow a two-dimensional Gaussian out of it.
    for results in (expected, got):
        results[2], results[3] = results[2][:, :2], results[3][:, [0, 3]]
    assert_close(got, expected)


@pytest.mark.parametrize("kernel", ["reference", "fast"])
def test_no_gaussians(kernel, fast, poison_empty):
    results = run_voxelise(gaussians(0), voxel_box(), *(fast if kernel == "fast" else ("reference", "cpu")))
    assert results[0].shape == (3, 11, 14, 17)
    assert (results[0] == 0).all()
    assert [tuple(t.shape) for t in results[1:]] == [(0, 3), (0, 3), (0, 4), (3, 0)]


def test_gaussians_outside_the_box(fast, poison_empty):
    scene = as_float32(gaussians(9))
    scene[0] += torch.tensor([0.0, 40.0, 0.0])
    assert all((t == 0).all() for t in run_voxelise(scene, voxel_box(), *fast))


def test_one_gaussian_larger_than_the_box(fast):
    scene = as_float32(gaussians(1, size=30.0))
    expected = run_voxelise(scene, voxel_box())
    assert (expected[0] > 0).all()
    assert_close(run_voxelise(scene, voxel_box(), *fast), expected)


def test_density_gradient_is_the_adjoint(fast):
    scene = as_float32(gaussians(61))
    results = run_voxelise(scene, voxel_box(), *fast)
    volume, cotangent = results[0].double(), random_like(results[0])
    difference = (volume * cotangent).sum() - (scene[3] * results[4].double()).sum()
    assert abs(difference) < 1e-6 * volume.norm() * cotangent.norm()


def test_part_of_a_box_is_that_part_of_the_volume(fast):
    scene, box = as_float32(gaussians(61)), voxel_box()
    whole = run_voxelise(scene, box, *fast)[0]
    part = run_voxelise(scene, box.part((3, 2, 5), (4, 9, 11)), *fast)[0]
    torch.testing.assert_close(part, whole[:, 3:7, 2:11, 5:16], rtol=1e-4, atol=1e-6)


def test_part_keeps_the_voxel_centres():
    part = VoxelBox(np.array([1.0, 2.0, 3.0]), np.array([0.1, 0.2, 0.3]), (9, 9, 9)).part(
        (2, 1, 4), (3, 3, 3)
    )
    np.testing.assert_allclose(part.first, [1.4, 2.2, 3.6])
    assert part.shape == (3, 3, 3)


def _bits(results):
    return [t.numpy().tobytes() for t in results]


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_same_bits_for_any_threads_and_from_two_threads_at_once(threads, monkeypatch):
    from tomo_polysplat import parallel
    from tomo_polysplat.kernels.voxelise import numba_kernel

    scene, box = as_float32(gaussians(200)), voxel_box()
    first = _bits(run_voxelise(scene, box, "numba"))
    monkeypatch.setattr(parallel, "cpu_threads", lambda: threads)
    monkeypatch.setattr(numba_kernel, "cpu_threads", lambda: threads)
    with ThreadPoolExecutor(2) as pool:
        others = list(pool.map(lambda _: _bits(run_voxelise(scene, box, "numba")), range(4)))
    assert all(bits == first for bits in others)

"""Compiled projections against the float64 reference: images, every gradient, and the bits themselves."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import torch
from splat_scenes import (
    VIEWS,
    as_float32,
    assert_close,
    cone_views,
    gaussians,
    parallel_views,
    random_like,
    run_project,
)

from tomo_polysplat.kernels.project.autograd import project


@pytest.mark.parametrize("name", VIEWS)
@pytest.mark.parametrize("channels", [1, 3])
def test_image_and_gradients_match_the_reference(name, channels, fast, poison_empty):
    views = VIEWS[name]
    scene = as_float32(gaussians(61, channels=channels, planar=views.planar))
    expected, skipped = run_project(scene, views)
    got, also_skipped = run_project(scene, views, *fast)
    assert skipped == also_skipped == 0
    if views.planar:  # The scale of the missing dimension is infinite and has no gradient.
        expected[2], got[2] = expected[2][:, :2], got[2][:, :2]
    assert_close(got, expected)


@pytest.mark.parametrize("size", [0.01, 0.03, 0.1, 0.4])
@pytest.mark.parametrize("make_views", [cone_views, parallel_views])
def test_footprints_from_under_a_pixel_to_half_the_detector(make_views, size, fast):
    views = make_views(2, 37, 53)
    scene = as_float32(gaussians(40, seed=1, size=size))
    assert_close(run_project(scene, views, *fast)[0], run_project(scene, views)[0])


@pytest.mark.parametrize("make_views", [cone_views, parallel_views])
def test_one_gaussian_covering_the_detector(make_views, fast):
    scene = as_float32(gaussians(1, seed=2))
    scene[0] *= 0.1
    scene[1] = torch.tensor([[1.1, 1.2, 1.3]], dtype=torch.float64)
    expected, _ = run_project(scene, make_views())
    assert (expected[0] > 0).all()
    assert_close(run_project(scene, make_views(), *fast)[0], expected)


@pytest.mark.parametrize("shape", ["needle", "pancake"])
@pytest.mark.parametrize("make_views", [cone_views, parallel_views])
def test_aspect_ratio_of_a_thousand(make_views, shape, fast):
    scene = gaussians(200, seed=3)
    thin = {"needle": [1.0, 1e-3, 1e-3], "pancake": [1.0, 1.0, 1e-3]}[shape]
    scene[1] = torch.tensor(thin, dtype=torch.float64).expand(200, 3)
    scene = as_float32(scene)
    # A hundredth of a pixel thin: rounding a pixel coordinate of 70 in float32 moves it by 5e-4 of its width.
    # Cut where the step is small, so that a pixel on the edge, in one image and not in the other, is no matter.
    views = make_views(2, 61, 71)
    expected, skipped = run_project(scene, views, cutoff=4.5)
    got, also_skipped = run_project(scene, views, *fast, cutoff=4.5)
    assert skipped == also_skipped
    assert_close(got, expected, image=3e-4, gradient=1e-3)


def test_needles_that_point_at_the_source(fast):
    """Along its axis a needle is longest in deviations of its width: |e| varies most over the footprint."""
    views, scene = cone_views(1, 61, 71), gaussians(100, seed=9)
    along = scene[0] - torch.as_tensor(views.origin[0])
    # The half-way quaternion, 1 + x . a and x cross a, turns the x axis to a.
    along = along / along.norm(dim=1, keepdim=True)
    x = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64).expand(100, 3)
    scene[2] = torch.cat([1 + along[:, :1], torch.linalg.cross(x, along)], dim=1)
    scene[1] = torch.tensor([0.9, 0.01, 0.01], dtype=torch.float64).expand(100, 3)
    scene = as_float32(scene)
    expected, skipped = run_project(scene, views)
    assert skipped == 0
    assert_close(run_project(scene, views, *fast)[0], expected, image=1e-4)


@pytest.mark.parametrize("cutoff", [1.0, 6.0, 12.0, 40.0])
@pytest.mark.parametrize("make_views", [cone_views, parallel_views])
def test_other_cutoffs(make_views, cutoff, fast):
    scene = as_float32(gaussians(23, seed=4, size=0.05))
    expected, skipped = run_project(scene, make_views(), cutoff=cutoff)
    assert skipped == 0
    assert_close(run_project(scene, make_views(), *fast, cutoff=cutoff)[0], expected)


def test_gaussians_that_reach_the_source_plane_are_left_out_and_counted_alike(fast, poison_empty):
    """Behind the source, round it, and beside it across its plane; the others are projected as ever."""
    views = cone_views(4, distance=1.0)
    scene = as_float32(gaussians(300, seed=5, size=0.15))
    scene[0] *= 2.0
    expected, skipped = run_project(scene, views)
    got, also_skipped = run_project(scene, views, *fast)
    assert 100 < skipped == also_skipped < 1000
    assert_close(got, expected, image=1e-4, gradient=1e-3)


def test_no_gaussian_in_front_of_the_source(fast, poison_empty):
    views = cone_views(1)
    scene = as_float32(gaussians(5))
    scene[0] += 3 * torch.as_tensor(views.origin[0])
    results, skipped = run_project(scene, views, *fast)
    assert skipped == 5
    assert all((t == 0).all() for t in results)


@pytest.mark.parametrize("kernel", ["reference", "fast"])
@pytest.mark.parametrize("name", ["cone", "parallel", "fan"])
def test_no_gaussians(kernel, name, fast, poison_empty):
    kernel, device = fast if kernel == "fast" else ("reference", "cpu")
    results, skipped = run_project(gaussians(0), VIEWS[name], kernel, device)
    assert skipped == 0
    assert results[0].shape == (3, 3, VIEWS[name].rows, VIEWS[name].columns)
    assert (results[0] == 0).all()
    assert [tuple(t.shape) for t in results[1:]] == [(0, 3), (0, 3), (0, 4), (3, 0)]


def test_gaussians_beside_the_detector_have_no_gradient(fast, poison_empty):
    scene = as_float32(gaussians(9))
    scene[0][:, 2] += 50.0
    assert all((t == 0).all() for t in run_project(scene, parallel_views(), *fast)[0])


@pytest.mark.parametrize("name", ["cone", "parallel", "fan"])
def test_density_channel_is_linear_and_its_gradient_the_adjoint(name, fast):
    views = VIEWS[name]
    scene = as_float32(gaussians(61, planar=views.planar))
    results, _ = run_project(scene, views, *fast)
    image, weight_gradient = results[0].double(), results[4].double()
    cotangent = random_like(image)
    # Float32 sums of about 1e3 terms on either side, against the Cauchy-Schwarz bound.
    bound = 1e-6 * image.norm() * cotangent.norm()
    assert abs((image * cotangent).sum() - (scene[3] * weight_gradient).sum()) < bound
    twice, _ = run_project([*scene[:3], 2 * scene[3]], views, *fast)
    assert torch.equal(twice[0], 2 * results[0])


def test_views_together_are_the_views_one_by_one(fast):
    views = VIEWS["cone"]
    scene = as_float32(gaussians(61))
    together, _ = run_project(scene, views, *fast)
    cotangent = random_like(together[0])
    parts = [
        run_project(scene, views.select([v]), *fast, cotangent=cotangent[:, v : v + 1])[0]
        for v in range(len(views))
    ]
    images = torch.cat([part[0] for part in parts], dim=1)
    torch.testing.assert_close(together[0], images, rtol=1e-6, atol=1e-6 * float(images.max()))
    for k in range(1, 5):
        total = sum(part[k] for part in parts)
        assert (together[k] - total).norm() < 1e-5 * total.norm()


def test_length_and_sign_of_the_quaternion_do_not_matter(fast):
    scene = as_float32(gaussians(61))
    other = [scene[0], scene[1], -4.0 * scene[2], scene[3]]
    first, second = (run_project(s, VIEWS["cone"], *fast)[0] for s in (scene, other))
    torch.testing.assert_close(first[0], second[0], rtol=1e-5, atol=1e-6)
    torch.testing.assert_close(first[3], -4.0 * second[3], rtol=1e-3, atol=1e-4)
    along = (second[3].double() * other[2]).sum(dim=1)
    assert along.abs().max() < 1e-6 * second[3].norm() * other[2].norm()


def _bits(results):
    return [t.numpy().tobytes() for t in results]


def test_the_same_bits_every_time_also_from_two_threads_at_once():
    scene, views = as_float32(gaussians(300)), VIEWS["cone"]
    first = _bits(run_project(scene, views, "numba")[0])
    with ThreadPoolExecutor(2) as pool:
        others = list(pool.map(lambda _: _bits(run_project(scene, views, "numba")[0]), range(6)))
    assert all(bits == first for bits in others)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_same_bits_for_any_number_of_threads(threads, monkeypatch):
    from tomo_polysplat import parallel
    from tomo_polysplat.kernels.project import numba_kernel

    scene, views = as_float32(gaussians(300)), VIEWS["cone"].select([1])
    first = _bits(run_project(scene, views, "numba")[0])
    monkeypatch.setattr(parallel, "cpu_threads", lambda: threads)
    monkeypatch.setattr(numba_kernel, "cpu_threads", lambda: threads)
    assert _bits(run_project(scene, views, "numba")[0]) == first


def test_thread_limit_of_the_environment(monkeypatch):
    from tomo_polysplat.parallel import cpu_threads

    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    assert cpu_threads() == 1


def test_gradient_that_is_not_contiguous():
    """Autograd may hand the backward an expanded or a transposed cotangent."""
    scene = [t.float().requires_grad_() for t in gaussians(11)]
    image, _ = project(*scene, VIEWS["cone"], kernel="numba", cutoff=3.0)
    expanded = torch.autograd.grad(image.sum(), scene, retain_graph=True)
    full = torch.autograd.grad(image, scene, torch.ones(image.shape))
    assert all(torch.equal(a, b) for a, b in zip(expanded, full, strict=True))


def test_single_precision_inputs_are_not_changed():
    scene = [t.float() for t in gaussians(11)]
    before = [t.clone() for t in scene]
    project(*scene, VIEWS["cone"], kernel="numba", cutoff=3.0)
    assert all(torch.equal(a, b) for a, b in zip(scene, before, strict=True))
    assert all(np.isfinite(t.numpy()).all() for t in scene)

"""The gradient of the projection by the vectors of its views: source, detector steps and the ray to the first pixel."""

import numpy as np
import pytest
import torch
from splat_scenes import (
    VIEWS,
    as_float32,
    gaussians,
    random_like,
    run_project,
    vector_gradient,
)

from tomo_polysplat.kernels.project.autograd import project


@pytest.mark.parametrize("name", VIEWS)
def test_finite_differences_of_the_reference(name):
    """Along random moves of all vectors at once, far enough out that no pixel crosses a Gaussian's end."""
    views = VIEWS[name]
    scene, vectors = gaussians(31, planar=views.planar), torch.from_numpy(views.vectors)
    gradient = vector_gradient(scene, views, cutoff=8.0)
    for seed in range(3):
        noise = torch.randn(vectors.shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
        move = 0.02 * vectors.norm(dim=2, keepdim=True) * noise

        def product(step, move=move):
            moved = views.moved((vectors + step * move).numpy())
            image, _ = project(*scene, moved, kernel="reference", cutoff=8.0)
            return float((image * random_like(image)).sum())

        h = 1e-5
        difference = (8 * (product(h) - product(-h)) - product(2 * h) + product(-2 * h)) / (12 * h)
        assert float((gradient * move).sum()) == pytest.approx(difference, rel=1e-6)


@pytest.mark.parametrize("name", VIEWS)
def test_compiled_kernels_agree_with_the_reference(name, fast, poison_empty):
    views = VIEWS[name]
    scene = as_float32(gaussians(61, planar=views.planar))
    expected, got = vector_gradient(scene, views), vector_gradient(scene, views, *fast)
    # The step from row to row is none where there is one row, and in a plane nothing at all.
    for k in (0, 1, 3) if views.rows == 1 else range(4):
        assert (got[:, k] - expected[:, k]).norm() < 1e-5 * expected[:, k].norm()


@pytest.mark.parametrize("name", ["cone", "parallel"])
def test_what_moves_with_the_gaussians_or_lengthens_all_vectors_changes_nothing(name, fast):
    views, scene = VIEWS[name], as_float32(gaussians(61))
    gradient, vectors = vector_gradient(scene, views, *fast), torch.from_numpy(views.vectors)
    of_positions = run_project(scene, views, *fast)[0][1].double()
    together = gradient[:, 0].sum(dim=0) + of_positions.sum(dim=0)
    assert together.norm() < 1e-5 * of_positions.sum(dim=0).norm()
    if views.cone:
        along = (gradient * vectors)[:, 1:]
        assert (along.sum(dim=(1, 2)).abs() < 1e-5 * along.abs().sum(dim=(1, 2))).all()


def test_the_other_gradients_keep_their_bits(fast):
    kernel, device = fast
    views = VIEWS["cone"]
    results = []
    for vectors in (None, torch.from_numpy(views.vectors).requires_grad_()):
        leaves = [t.to(device, torch.float32).requires_grad_() for t in gaussians(300)]
        image, _ = project(*leaves, views, kernel=kernel, cutoff=3.0, vectors=vectors)
        (image * random_like(image).to(image)).sum().backward()
        results.append([leaf.grad for leaf in leaves])
    assert all(torch.equal(a, b) for a, b in zip(*results, strict=True))


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_the_same_bits_for_any_number_of_threads(threads, monkeypatch):
    from tomo_polysplat import parallel
    from tomo_polysplat.kernels.project import numba_kernel

    scene, views = as_float32(gaussians(300)), VIEWS["cone"]
    first = vector_gradient(scene, views, "numba")
    monkeypatch.setattr(parallel, "cpu_threads", lambda: threads)
    monkeypatch.setattr(numba_kernel, "cpu_threads", lambda: threads)
    assert torch.equal(vector_gradient(scene, views, "numba"), first)


def test_no_gaussians_pull_at_no_view(fast, poison_empty):
    gradient = vector_gradient(gaussians(0), VIEWS["cone"], *fast)
    assert gradient.shape == (3, 4, 3) and (gradient == 0).all()


def test_moved_views_are_those_of_their_vectors():
    views = VIEWS["cone"]
    other = views.moved(views.vectors)
    assert np.array_equal(other.origin, views.origin) and np.array_equal(other.matrix, views.matrix)
    assert (other.cone, other.rows, other.columns) == (True, 23, 37)

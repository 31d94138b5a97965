"""Views by smaller pixels are the same views, and so are chosen ones; the lengths of their rays."""

import numpy as np
import pytest
import torch
from splat_scenes import cone_views, gaussians, parallel_views, planar_views

from tomo_polysplat.kernels.project.autograd import project

VIEWS = {
    "cone": cone_views(),
    "parallel": parallel_views(),
    "fan": planar_views(True),
    "2d": planar_views(False),
}


@pytest.mark.parametrize("kind", VIEWS)
def test_the_middle_of_three_parts_is_the_pixel(kind):
    views = VIEWS[kind]
    cloud = gaussians(11, size=0.2, planar=views.planar)
    whole, fine = (project(*cloud, of, kernel="reference", cutoff=9.0)[0] for of in (views, views.finer(3)))
    rows = 1 if views.planar else 3
    middle = fine.reshape(-1, len(views), views.rows, rows, views.columns, 3)[:, :, :, rows // 2, :, 1]
    torch.testing.assert_close(middle, whole, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("kind", VIEWS)
def test_parts_cover_the_outline_of_the_detector(kind):
    views = VIEWS[kind]
    fine = views.finer(2)
    ends = []
    for of in (views, fine):
        first = of.matrix[:, :, 2] if of.cone else of.origin
        ends.append(first - 0.5 * of.matrix[:, :, 0] - (0 if of.planar else 0.5) * of.matrix[:, :, 1])
    np.testing.assert_allclose(*ends, rtol=1e-12, atol=1e-12)
    assert fine.columns == 2 * views.columns and fine.rows == views.rows * (1 if views.planar else 2)


@pytest.mark.parametrize("kind", VIEWS)
def test_the_lengths_of_rays_are_those_of_their_vectors(kind):
    """On a CPU by numpy, and by torch where they are differentiated: the same to the bit."""
    views = VIEWS[kind]
    found = views.ray_lengths("cpu", torch.float32)
    assert torch.equal(found, views.ray_lengths("cpu", torch.float32, torch.from_numpy(views.vectors)))
    u, v, d = (views.matrix[:, None, None, :, k] for k in range(3))
    row, column = np.arange(views.rows)[:, None, None], np.arange(views.columns)[:, None]
    ray = d + row * v + column * u if views.cone else d + 0 * (row + column)
    np.testing.assert_allclose(found, np.linalg.norm(ray, axis=-1), rtol=1e-5)


@pytest.mark.parametrize("kind", VIEWS)
def test_chosen_views_have_the_inverses_of_their_matrices(kind):
    views = VIEWS[kind].select([1, 0, 1])
    expected = np.broadcast_to(np.eye(3), (3, 3, 3))
    np.testing.assert_allclose(views.select([2, 0, 1]).inverse @ views.matrix[[2, 0, 1]], expected, atol=1e-9)

"""Whether matter lies beside a volume, told by the rays that pass beside it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.inside import _crosses, matter_is_inside
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid

GRID = VolumeGrid((5, 7, 9), [-0.9, -0.7, -0.5], [0.9, 0.7, 0.5])


def scanner(beam, views=11, rows=13, columns=17):
    angle = 2 * np.pi * np.arange(views) / views
    across = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    out = np.stack([np.sin(angle), -np.cos(angle), 0 * angle], 1)
    u, v = 0.3 * across, 0.2 * np.tile([0.0, 0.0, 1.0], (views, 1))
    corner = -2.0 * out - 0.5 * (columns - 1) * u - 0.5 * (rows - 1) * v
    return Geometry(beam, 4.0 * out if beam == "cone" else -out, corner, u, v, rows, columns)


def crosses(geometry):
    rows, columns = np.arange(geometry.rows), np.arange(geometry.columns)
    return _crosses(geometry, GRID, rows, columns, torch.device("cpu"))


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_rays_that_cross_are_those_with_a_point_inside(beam):
    geometry = scanner(beam)
    crossed = crosses(geometry)
    row, column = np.mgrid[: geometry.rows, : geometry.columns][..., None]
    for view in range(geometry.views):
        pixel = geometry.corner[view] + row * geometry.v[view] + column * geometry.u[view]
        origin = geometry.origin[view] if beam == "cone" else pixel - 6 * geometry.origin[view]
        points = origin + np.linspace(0, 1, 2001)[:, None, None, None] * (pixel - origin)
        within = ((points > GRID.lower) & (points < GRID.upper)).all(axis=-1).any(axis=0)
        # Sampled points miss a ray that cuts a corner only.
        assert not (within & ~crossed[view]).any() and (crossed[view] & ~within).mean() < 0.02
    assert 0.05 < crossed.mean() < 0.95


@pytest.mark.parametrize("beside, inside", [(0.0, True), (0.02, True), (1.0, False), (np.nan, False)])
def test_the_rays_beside_the_volume_decide(beside, inside):
    geometry = scanner("cone")
    values = np.where(crosses(geometry), 1.0, beside).astype(np.float32)
    assert matter_is_inside(torch.from_numpy(values), geometry, GRID)[0] == inside


@pytest.mark.gpu
@pytest.mark.parametrize("beside", [0.02, 1.0, np.nan])
def test_a_gpu_says_the_same(beside):
    geometry = scanner("cone")
    values = torch.from_numpy(np.where(crosses(geometry), 1.0, beside).astype(np.float32))
    expected = matter_is_inside(values, geometry, GRID)
    assert matter_is_inside(values.cuda(), geometry, GRID) == expected


def test_a_holder_on_few_rays_is_matter_beside():
    geometry = scanner("cone")
    values = np.where(crosses(geometry), 1.0, 0.0).astype(np.float32)
    values[:, :, 0] = 0.5
    assert not matter_is_inside(torch.from_numpy(values), geometry, GRID)[0]


def a_ball(geometry, radius):
    """Chords of a ball around the origin, by every ray of a cone beam."""
    row, column = np.mgrid[: geometry.rows, : geometry.columns][..., None]
    rays = [
        geometry.corner[v] + row * geometry.v[v] + column * geometry.u[v] - geometry.origin[v]
        for v in range(geometry.views)
    ]
    along = np.stack([r / np.linalg.norm(r, axis=-1, keepdims=True) for r in rays])
    distance = np.linalg.norm(np.cross(along, geometry.origin[:, None, None]), axis=-1)
    return (2 * np.sqrt(np.clip(radius**2 - distance**2, 0, None))).astype(np.float32)


@pytest.mark.parametrize(
    "half, height, told", [(0.8, 0.8, False), (0.3, 0.8, True), (0.1, 0.1, True), (0.8, 0.2, False)]
)
def test_a_volume_smaller_than_the_object_is_told(half, height, told, caplog):
    """But not one of fewer slices, which is a part that was chosen."""
    grid = VolumeGrid((5, 7, 7), [-half, -half, -height], [half, half, height])
    geometry = scanner("cone", rows=31, columns=41)
    values = a_ball(geometry, 0.75) + 0.01 * np.random.default_rng(0).normal(size=geometry.shape)
    why = matter_is_inside(torch.from_numpy(values.astype(np.float32)), geometry, grid)[1]
    assert ("reaches beyond it" in why) == told == ("Make the volume larger" in caplog.text)


@pytest.mark.parametrize("upper, told", [([0.061, 0.061, 0.061], True), ([1.0, 1.0, 0.15], False)])
def test_a_volume_that_no_ray_meets_is_told(upper, told, caplog):
    """Not a thin slice that rays meet, though none of those that are looked at."""
    geometry = scanner("cone", rows=256, columns=130)
    grid = VolumeGrid((1, 7, 7), [0.06, 0.06, 0.06], upper)
    why = matter_is_inside(torch.zeros(geometry.shape), geometry, grid)[1]
    assert ("no ray meets" in why) == told == ("No ray meets the volume" in caplog.text)


def test_a_detector_that_sees_no_more_than_the_volume_tells_nothing():
    values = torch.zeros(11, 1, 3)
    assert not matter_is_inside(values, scanner("cone", rows=1, columns=3), GRID)[0]


def test_what_has_left_a_closed_volume_comes_back_to_its_faces():
    box = VoxelBox(np.array([-0.8, -0.6, -0.4]), np.array([0.2, 0.2, 0.2]), (5, 7, 9))
    scene = FitScene(box, None, 1.0, None, None, 0.0, "reference", 0.1, False, (0.1, 0.1), True, 1, 0.2)

    class Cloud:
        position = torch.tensor([[1.5, 0.1, -0.9], [0.85, -0.65, 0.45]])

    scene.keep_within(Cloud)
    expected = torch.tensor([[0.9, 0.1, -0.5], [0.85, -0.65, 0.45]])
    torch.testing.assert_close(Cloud.position, expected)
    Cloud.position = torch.tensor([[1.5, 0.1, -0.9]])
    replace(scene, closed=False).keep_within(Cloud)
    assert float(Cloud.position[0, 0]) == 1.5


@pytest.mark.parametrize("ends, told", [((1.0, 1.0), True), ((1.0, 0.0), False), ((0.0, 0.0), False)])
def test_an_object_that_reaches_beyond_both_ends_of_the_detector_is_told(ends, told, caplog):
    """Of a detector that is shifted to one side, one end alone sees matter."""
    geometry = scanner("cone", columns=5)
    wide = VolumeGrid((5, 7, 9), [-9, -7, -5], [9, 7, 5])
    values = torch.ones(geometry.shape)
    values[:, :, 0], values[:, :, -1] = ends
    closed, why = matter_is_inside(values, geometry, wide)
    assert not closed and ("beyond the detector" in why) == told == ("large enough" in caplog.text)


def test_a_flat_object_that_reaches_beyond_the_detector_is_told_by_the_rows_that_see_it():
    geometry = scanner("cone", columns=5)
    values = torch.zeros(geometry.shape)
    values[:, 5:8] = 1.0
    assert (
        "beyond the detector"
        in matter_is_inside(values, geometry, VolumeGrid((5, 7, 9), [-9] * 3, [9] * 3))[1]
    )

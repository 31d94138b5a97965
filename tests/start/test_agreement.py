"""Whether two halves of the views agree: on noise they must not, on what is there they must."""

import astra
import numpy as np
import pytest
import torch
from start_phantoms import chords

from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.start import agreement
from tomo_polysplat.start.agreement import halves_agree

VIEWS = 121
ANGLES = 2 * np.pi * np.arange(VIEWS) / VIEWS
GEOMETRY, GRID = from_astra(
    astra.create_proj_geom("cone", 1.0, 1.0, 15, 49, ANGLES, 200.0, 50.0), astra.create_vol_geom(31, 33, 11)
)


def everywhere():
    return torch.ones(GRID.shape, dtype=torch.bool)


def texture(seed=0):
    """Many small spheres, which every view sees."""
    rng = np.random.default_rng(seed)
    centres = rng.uniform(-1, 1, (60, 3)) * [14, 13, 4]
    return chords(GEOMETRY, [(c, 2.5, v) for c, v in zip(centres, rng.uniform(0.5, 1.5, 60))])


def noise(seed=1):
    return np.random.default_rng(seed).normal(size=GEOMETRY.shape).astype(np.float32)


def test_noise_is_agreed_on_by_chance():
    (found,) = halves_agree(torch.from_numpy(noise()), GEOMETRY, GRID, [everywhere()])
    assert abs(found) < 0.05


def test_texture_is_agreed_on_the_more_the_less_noise_there_is():
    values, disturbed = texture(), noise()
    found = [
        halves_agree(torch.from_numpy(values + s * disturbed), GEOMETRY, GRID, [everywhere()])[0]
        for s in (0.0, 5.0, 200.0)
    ]
    assert found[0] > 0.4
    assert found[0] > found[1] + 0.1
    assert found[1] > found[2] + 0.1
    assert abs(found[2]) < 0.1


def test_bodies_are_judged_apart():
    """Texture on one side of the volume and noise alone on the other."""
    rng = np.random.default_rng(3)
    spheres = [
        (c, 1.5, v)
        for c, v in zip(rng.uniform(-1, 1, (40, 3)) * [5, 13, 4] + [-9, 0, 0], rng.uniform(1, 3, 40))
    ]
    values = torch.from_numpy(chords(GEOMETRY, spheres) + 0.5 * noise())
    left, right = everywhere(), everywhere()
    left[..., 16:], right[..., :22] = False, False
    textured, plain = halves_agree(values, GEOMETRY, GRID, [left, right])
    # Where there is nothing, the halves' streaks of the spheres contradict each other.
    assert textured > 0.3
    assert plain < 0.05


@pytest.mark.parametrize("shape", [(11, 13, 17), (1, 20, 30), (9, 1, 5)])
def test_pairs_are_counted_by_slabs(monkeypatch, shape):
    """By hand: each pair along an axis of which both voxels are in the body counts once."""
    rng = np.random.default_rng(0)
    one, other, body = rng.normal(size=shape), rng.normal(size=shape), rng.random(shape) < 0.8
    signs = pairs = 0
    for axis in range(3):
        first, last = (np.delete(body, k, axis) for k in (0, shape[axis] - 1))
        both = first & last
        signs += (np.sign(np.diff(one, axis=axis)) * np.sign(np.diff(other, axis=axis)))[both].sum()
        pairs += both.sum()
    monkeypatch.setattr(agreement, "_AT_ONCE", 100)
    assert agreement._signs(*map(torch.from_numpy, (one, other, body))) == (signs, pairs)


def test_a_view_seen_twice_is_no_proof():
    twice = np.repeat(np.arange(VIEWS), 2)
    values = torch.from_numpy(noise())[torch.from_numpy(twice)]
    (found,) = halves_agree(values, GEOMETRY.select(twice), GRID, [everywhere()])
    assert abs(found) < 0.05


def test_nor_are_parallel_rays_that_come_from_the_other_side():
    """Half a turn on, which is an odd number of views here, each ray is seen again."""
    angles = 2 * np.pi * np.arange(2 * VIEWS) / (2 * VIEWS)
    geometry, _ = from_astra(
        astra.create_proj_geom("parallel3d", 1.0, 1.0, 11, 49, angles), astra.create_vol_geom(9, 9, 3)
    )
    first = np.random.default_rng(4).normal(size=(VIEWS, 11, 49)).astype(np.float32)
    values = torch.from_numpy(np.concatenate([first, first[:, :, ::-1]]))
    (found,) = halves_agree(values, geometry, GRID, [everywhere()])
    assert abs(found) < 0.05


@pytest.mark.parametrize("what", ["few views", "few voxels", "no orbit", "a volume too large"])
def test_what_cannot_be_told_is_not(what, monkeypatch):
    geometry, body = GEOMETRY, everywhere()
    if what == "few views":
        geometry = GEOMETRY.select(np.arange(0, VIEWS, 2))
    if what == "few voxels":
        body[2:], body[:, 3:] = False, False
    if what == "no orbit":
        geometry = GEOMETRY.select(np.r_[0:VIEWS, 0:VIEWS] % 20)
    if what == "a volume too large":
        monkeypatch.setattr(agreement, "_MOST_ADDITIONS", 1e3)
    values = torch.zeros(geometry.shape)
    assert halves_agree(values, geometry, GRID, [body, body]) == [None, None]

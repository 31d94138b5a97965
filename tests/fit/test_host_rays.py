"""Rays that leave the host: what is read of them is what was there."""

import numpy as np
import pytest
import torch

from tomo_polysplat.fit import host_rays
from tomo_polysplat.fit.host_rays import HostRays

CPU = torch.device("cpu")


def some_rays(seed=0):
    rng = np.random.default_rng(seed)
    values = rng.random((11, 3, 7)).astype(np.float32)
    values[4, 1] = np.nan
    return values


def test_on_the_host_they_are_shared():
    array = some_rays()
    rays = HostRays(array)
    assert np.shares_memory(rays.on(CPU).numpy(), array) and np.shares_memory(np.asarray(rays), array)


def test_what_has_left_is_read_from_the_device(monkeypatch):
    """A copy on the host stands for one on a GPU."""
    monkeypatch.setattr(host_rays, "to_device", lambda array, device: torch.from_numpy(array).clone())
    array = some_rays()
    rays = HostRays(array.copy())
    held = rays.on(CPU)
    assert rays._array is None and rays.on(CPU) is held
    assert (rays.shape, rays.size, rays.nbytes, len(rays)) == (array.shape, array.size, array.nbytes, 11)
    for key in (3, slice(None, None, 4), (slice(None), np.array([2, 0])), (slice(2, 9), 1, slice(1, 5))):
        np.testing.assert_array_equal(rays[key], array[key])
    np.testing.assert_array_equal(np.asarray(rays), array)
    held -= 1.0
    np.testing.assert_array_equal(rays[0], array[0] - 1)


def test_without_room_they_stay(monkeypatch):
    monkeypatch.setattr(host_rays, "projections_stay", lambda size, device: False)
    array = some_rays()
    rays = HostRays(array)
    assert np.shares_memory(rays.on(torch.device("cuda", 0)).numpy(), array) and rays._array is array


@pytest.mark.gpu
def test_a_run_on_a_gpu_keeps_none_on_the_host():
    array = some_rays()
    rays = HostRays(array.copy())
    assert rays.on(torch.device("cuda", 0)).is_cuda and rays._array is None
    np.testing.assert_array_equal(np.asarray(rays), array)
    np.testing.assert_array_equal(rays[::3], array[::3])

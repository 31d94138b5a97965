"""Volumes of Gaussians on the host, made slab by slab of z where a device has no room for all at once."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch

from tomo_polysplat.fit.memory import voxels_at_once
from tomo_polysplat.fit.volume_by_ranks import volume_by_ranks
from tomo_polysplat.start.slabs import slabs
from tomo_polysplat.transfer import to_host

__all__ = ["on_host"]


def on_host(
    make: Callable[[int, int], torch.Tensor],
    channels: int,
    shape: tuple[int, int, int],
    device: torch.device,
    *,
    halo: int = 0,
    most: int | None = None,
) -> np.ndarray:
    """A volume on the host of which a device holds a slab at a time.

    Parameters
    ----------
    make : callable
        Gets the first slice and the one behind the last, and makes (channels, slices, ny, nx) of them. Other ranks get
        it, if there are any.
    channels : int
    shape : (nz, ny, nx)
    device : torch.device
        Where they are made.
    halo : int
        Slices at either end of a slab that come out otherwise than in the whole, and are left out.
    most : int, optional
        Voxels of a slab, without the halo; None: as many as there is room for.

    Returns
    -------
    (channels, nz, ny, nx) array
        The same whatever the size of a slab, to rounding.
    """
    nz, ny, nx = shape
    most = voxels_at_once(device) if most is None else most
    shared = volume_by_ranks(make, channels, shape, device, halo, most)
    if shared is not None:
        return shared
    depth = max(1, most // (ny * nx))
    if depth >= nz:
        return to_host(make(0, nz))
    whole = np.empty((channels, *shape), np.float32)
    for wanted, first, last in slabs(nz, depth, halo):
        part = make(first, last)[:, wanted.start - first : wanted.stop - first]
        for channel, values in zip(whole, part):
            to_host(values, channel[wanted])
    return whole

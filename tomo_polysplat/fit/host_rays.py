"""The measured rays of a run on a GPU: they are on the host until the GPU has them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.memory import projections_stay
from tomo_polysplat.transfer import to_device, to_host

__all__ = ["HostRays"]


class HostRays:
    """An array of which the host keeps nothing once it was copied to a device with room for it.

    Whoever reads it later gets what is read, from the device. Gains and drift that were taken out there are taken out
    of it too, as on a CPU.

    Parameters
    ----------
    array : (views, rows, columns) float32 array
        That nobody else keeps.
    """

    def __init__(self, array: np.ndarray) -> None:
        self.shape, self.dtype, self.ndim = array.shape, array.dtype, array.ndim
        self.size, self.nbytes = array.size, array.nbytes
        self._array: np.ndarray | None = array
        self._tensor: torch.Tensor | None = None

    def on(self, device: torch.device) -> torch.Tensor:
        """All of it on a device; on the host where that has no room for it."""
        if self._tensor is not None and self._tensor.device == device:
            return self._tensor
        array = np.asarray(self)
        if not projections_stay(self.nbytes, device):
            return torch.from_numpy(array)
        tensor = to_device(array, device)
        if self._array is not None and tensor.data_ptr() != array.ctypes.data:
            self._tensor, self._array = tensor, None
        return tensor

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        array = self._array
        if array is None:
            assert self._tensor is not None
            array = to_host(self._tensor)
        return array.astype(self.dtype if dtype is None else dtype, copy=bool(copy))

    def __getitem__(self, key: Any) -> np.ndarray:
        if self._array is not None:
            return self._array[key]
        assert self._tensor is not None
        keys = key if isinstance(key, tuple) else (key,)
        return to_host(self._tensor[tuple(torch.as_tensor(k) if np.ndim(k) else k for k in keys)])

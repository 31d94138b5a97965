"""Large arrays between the host and a GPU, through page-locked memory.

A copy from or to memory that the system may page out runs at a tenth of the bus: for a volume of 256^3 voxels it took
0.12 s, as long as making it. Here one piece is copied by several CPU threads while the next is on its way. They are not
torch's, which go on turning for a while after each copy and slow down whatever else the host does.
"""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.parallel import copy_array

__all__ = ["copied", "to_device", "to_host"]

_PIECE = 1 << 24  # bytes; less is not worth a buffer


def to_host(tensor: torch.Tensor, into: np.ndarray | None = None) -> np.ndarray:
    """A tensor as an array, which shares its memory where it is on the host, or written ``into`` a contiguous one."""
    tensor = tensor.detach()
    if not tensor.is_cuda or tensor.nbytes < _PIECE:
        small = tensor.cpu().numpy()
        if into is None or not small.size:
            return small
        copy_array(into, small)
        return into
    whole = torch.empty(tensor.shape, dtype=tensor.dtype) if into is None else torch.from_numpy(into)
    with torch.cuda.device(tensor.device):
        pieces, parts, buffers = _split(tensor.contiguous(), whole)
        arrived = [torch.cuda.Event(), torch.cuda.Event()]

        def fetch(k: int) -> None:
            buffers[k % 2][: len(pieces[k])].copy_(pieces[k], non_blocking=True)
            arrived[k % 2].record()

        fetch(0)
        for k, part in enumerate(parts):
            if k + 1 < len(parts):
                fetch(k + 1)
            arrived[k % 2].synchronize()
            copy_array(part.numpy(), buffers[k % 2][: len(part)].numpy())
    return whole.numpy()


def to_device(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """An array as a tensor on a device, which shares its memory where that is the host."""
    tensor = torch.from_numpy(array)
    if device.type != "cuda" or tensor.nbytes < _PIECE:
        return tensor.to(device)
    whole = torch.empty(tensor.shape, dtype=tensor.dtype, device=device)
    with torch.cuda.device(device):
        pieces, parts, buffers = _split(tensor.contiguous(), whole)
        left = [torch.cuda.Event(), torch.cuda.Event()]
        for k, (piece, part) in enumerate(zip(pieces, parts)):
            left[k % 2].synchronize()  # at once where it was never recorded
            buffer = buffers[k % 2][: len(piece)]
            copy_array(buffer.numpy(), piece.numpy())
            part.copy_(buffer, non_blocking=True)
            left[k % 2].record()
        # The buffers may go to others now.
        torch.cuda.current_stream().synchronize()
    return whole


def copied(tensor: torch.Tensor, device: torch.device) -> torch.Tensor:
    """A copy of a tensor without gradient on a device."""
    if tensor.is_cuda and device.type == "cpu":
        return torch.from_numpy(to_host(tensor))
    if device.type == "cuda" and not tensor.is_cuda and not tensor.is_pinned():
        return to_device(tensor.numpy(), device)
    return tensor.to(device, copy=True)


def _split(
    source: torch.Tensor, whole: torch.Tensor
) -> tuple[tuple[torch.Tensor, ...], tuple[torch.Tensor, ...], list[torch.Tensor]]:
    """Pieces of a tensor, their places in another, and two buffers for one each."""
    length = _PIECE // source.element_size()
    buffers = [torch.empty(length, dtype=source.dtype, pin_memory=True) for _ in range(2)]
    return source.view(-1).split(length), whole.view(-1).split(length), buffers

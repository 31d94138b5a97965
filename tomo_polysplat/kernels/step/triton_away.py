"""Which voxels of a volume have no edge beside them, in two CUDA kernels."""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.step.faint import BESIDE, EDGE
from tomo_polysplat.kernels.triton_maths import SIZES, on_device

__all__ = ["away_from_edges"]

_BLOCK = 256


@triton.jit(do_not_specialize=SIZES)
def _across_kernel(volume, most, least, nz, ny, nx, BESIDE: tl.constexpr, BLOCK: tl.constexpr):
    """Largest and least value up to BESIDE voxels along x and y from each voxel."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    live = at < tl.cast(nz, tl.int64) * ny * nx
    line = at // nx
    x, y = at - line * nx, line % ny
    high = tl.load(volume + at, mask=live, other=0.0)
    low = high
    for v in tl.static_range(0, 2 * BESIDE + 1):
        # A neighbour outside is the one at the end once more, which changes no extreme.
        start = at - x + (tl.minimum(tl.maximum(y + v - BESIDE, 0), ny - 1) - y) * nx
        for u in tl.static_range(0, 2 * BESIDE + 1):
            beside = start + tl.minimum(tl.maximum(x + u - BESIDE, 0), nx - 1)
            value = tl.load(volume + beside, mask=live, other=0.0)
            high, low = tl.maximum(high, value), tl.minimum(low, value)
    tl.store(most + at, high, mask=live)
    tl.store(least + at, low, mask=live)


@triton.jit(do_not_specialize=SIZES)
def _away_kernel(most, least, away, nz, ny, nx, edge, dense, BESIDE: tl.constexpr, BLOCK: tl.constexpr):
    """Whether the same along z, too, spans less than an edge and is not dense."""
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    plane = tl.cast(ny, tl.int64) * nx
    live = at < nz * plane
    z = at // plane
    high, low = tl.load(most + at, mask=live, other=0.0), tl.load(least + at, mask=live, other=0.0)
    for w in tl.static_range(0, 2 * BESIDE + 1):
        beside = at + (tl.minimum(tl.maximum(z + w - BESIDE, 0), nz - 1) - z) * plane
        high = tl.maximum(high, tl.load(most + beside, mask=live, other=0.0))
        low = tl.minimum(low, tl.load(least + beside, mask=live, other=0.0))
    tl.store(away + at, ((high - low < edge) & (high <= dense)).to(tl.int8), mask=live)


def away_from_edges(volume: torch.Tensor, corner: float, dense: float) -> torch.Tensor:
    """``fit.loss.away_from_edges`` of a volume (1, nz, ny, nx), as int8."""
    shape, (most, least) = volume.shape[1:], (torch.empty_like(volume) for _ in range(2))
    away = torch.empty_like(volume, dtype=torch.int8)
    blocks = (triton.cdiv(volume.numel(), _BLOCK),)
    with on_device(volume):
        _across_kernel[blocks](volume, most, least, *shape, BESIDE=BESIDE, BLOCK=_BLOCK, num_warps=4)
        _away_kernel[blocks](
            most, least, away, *shape, EDGE * corner, dense, BESIDE=BESIDE, BLOCK=_BLOCK, num_warps=4
        )
    return away

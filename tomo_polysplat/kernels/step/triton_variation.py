"""Gradient of the total variation of a volume, in one CUDA kernel."""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.triton_maths import SIZES, on_device

__all__ = ["variation_gradient"]

_BLOCK = 256


@triton.jit
def _slope(a, b, dense, by_corner, by_dense_corner):
    """Derivative of the penalty of a - b by a: the sign, less where the difference is large."""
    sign = tl.where(a > b, 1.0, 0.0) - tl.where(a < b, 1.0, 0.0)
    by_corner = tl.where(tl.maximum(a, b) > dense, by_dense_corner, by_corner)
    return sign / (1.0 + tl.abs(a - b) * by_corner)


@triton.jit
def _along(volume, at, value, index, length, stride, live, ceiling, dense, by_corner, by_dense_corner):
    """d/dvalue of the penalties of the differences from both neighbours along an axis."""
    before = tl.minimum(tl.load(volume + at - stride, mask=live & (index > 0), other=0.0), ceiling)
    after = tl.minimum(tl.load(volume + at + stride, mask=live & (index < length - 1), other=0.0), ceiling)
    slope = tl.where(index > 0, _slope(value, before, dense, by_corner, by_dense_corner), 0.0)
    rise = _slope(after, value, dense, by_corner, by_dense_corner)
    return slope - tl.where(index < length - 1, rise, 0.0)


@triton.jit(do_not_specialize=SIZES)
def _variation_kernel(
    volume, grad, largest, nz, ny, nx, count, ceiling, dense, by_corner, by_dense_corner, factor,
    BLOCK: tl.constexpr,
):  # fmt: skip
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    size = tl.cast(nz, tl.int64) * ny * nx
    live = at < size
    line = at // nx
    x, y, z = at - line * nx, line % ny, line // ny
    raw = tl.load(volume + at, mask=live, other=0.0)
    value = tl.minimum(raw, ceiling)
    tl.atomic_max(largest, tl.max(raw, 0), sem="relaxed")
    # The mean over an axis has a term less a line than the volume has voxels; of a slab, the whole volume.
    along_x = _along(volume, at, value, x, nx, 1, live, ceiling, dense, by_corner, by_dense_corner)
    along_y = _along(volume, at, value, y, ny, nx, live, ceiling, dense, by_corner, by_dense_corner)
    along_z = _along(volume, at, value, z, nz, nx * ny, live, ceiling, dense, by_corner, by_dense_corner)
    whole = tl.cast(count, tl.int64) * ny * nx
    slope = along_x / tl.maximum(whole - ny * count, 1)
    slope += along_y / tl.maximum(whole - nx * count, 1)
    slope += along_z / tl.maximum(whole - nx * ny, 1)
    tl.store(grad + at, tl.where(raw <= ceiling, slope * factor, 0.0), mask=live)


def variation_gradient(
    volume: torch.Tensor,
    ceiling: float,
    corners: tuple[float, float],
    dense: float,
    factor: float,
    largest: torch.Tensor,
    planes: int,
) -> torch.Tensor:
    """``factor`` times the gradient of ``fit.loss.total_variation`` of a volume (1, nz, ny, nx), so shaped.

    Of a slab it is that of the whole volume, of so many ``planes``, except in planes beside which the slab ends.
    ``largest``, a float32 tensor of one number, is raised to the largest value of the volume.
    """
    grad = torch.empty_like(volume)
    by_corners = [1 / corner if corner else 0.0 for corner in corners]
    with on_device(volume):
        _variation_kernel[(triton.cdiv(volume.numel(), _BLOCK),)](
            volume, grad, largest, *volume.shape[1:], planes, ceiling, dense, *by_corners, factor,
            BLOCK=_BLOCK, num_warps=4,
        )  # fmt: skip
    return grad

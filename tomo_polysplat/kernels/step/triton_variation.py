"""Gradient of the total variation of a volume, in one CUDA kernel."""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.step.faint import FAINT
from tomo_polysplat.kernels.step.triton_away import away_from_edges
from tomo_polysplat.kernels.triton_maths import SIZES, on_device

__all__ = ["variation_gradient"]

_BLOCK = 256


@triton.jit
def _slope(a, b, both, dense, by_corner, by_dense_corner, width):
    """Derivative of the penalty of a - b by a: the sign, less where the difference is large, or small in ``both``."""
    sign = tl.where(a > b, 1.0, 0.0) - tl.where(a < b, 1.0, 0.0)
    by_corner = tl.where(tl.maximum(a, b) > dense, by_dense_corner, by_corner)
    height = tl.abs(a - b)
    low = tl.minimum(height, width)
    height -= tl.where(both, low * (1.0 - 0.5 * low / width), 0.0)
    return sign * tl.where(both, low / width, 1.0) / (1.0 + height * by_corner)


@triton.jit
def _along(
    volume, away, at, value, faint, index, length, stride, live, dense, by_corner, by_dense_corner, width
):  # fmt: skip
    """d/dvalue of the penalties of the differences from both neighbours along an axis."""
    has_before, has_after = live & (index > 0), live & (index < length - 1)
    before = tl.load(volume + at - stride, mask=has_before, other=0.0)
    after = tl.load(volume + at + stride, mask=has_after, other=0.0)
    both_before = faint & (tl.load(away + at - stride, mask=has_before, other=0) != 0)
    both_after = faint & (tl.load(away + at + stride, mask=has_after, other=0) != 0)
    slope = _slope(value, before, both_before, dense, by_corner, by_dense_corner, width)
    rise = _slope(after, value, both_after, dense, by_corner, by_dense_corner, width)
    return tl.where(index > 0, slope, 0.0) - tl.where(index < length - 1, rise, 0.0)


@triton.jit(do_not_specialize=SIZES)
def _variation_kernel(
    volume, away, grad, largest, nz, ny, nx, count, dense, by_corner, by_dense_corner, width, factor,
    BLOCK: tl.constexpr,
):  # fmt: skip
    at = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
    size = tl.cast(nz, tl.int64) * ny * nx
    live = at < size
    line = at // nx
    x, y, z = at - line * nx, line % ny, line // ny
    value = tl.load(volume + at, mask=live, other=0.0)
    faint = tl.load(away + at, mask=live, other=0) != 0
    tl.atomic_max(largest, tl.max(value, 0), sem="relaxed")
    # The mean over an axis has a term less a line than the volume has voxels; of a slab, the whole volume.
    along_x = _along(
        volume, away, at, value, faint, x, nx, 1, live, dense, by_corner, by_dense_corner, width
    )  # fmt: skip
    along_y = _along(
        volume, away, at, value, faint, y, ny, nx, live, dense, by_corner, by_dense_corner, width
    )  # fmt: skip
    along_z = _along(
        volume, away, at, value, faint, z, nz, nx * ny, live, dense, by_corner, by_dense_corner, width
    )  # fmt: skip
    whole = tl.cast(count, tl.int64) * ny * nx
    slope = along_x / tl.maximum(whole - ny * count, 1)
    slope += along_y / tl.maximum(whole - nx * count, 1)
    slope += along_z / tl.maximum(whole - nx * ny, 1)
    tl.store(grad + at, slope * factor, mask=live)


def variation_gradient(
    volume: torch.Tensor,
    corners: tuple[float, float],
    dense: float,
    factor: float,
    largest: torch.Tensor,
    planes: int,
) -> torch.Tensor:
    """``factor`` times the gradient of ``fit.loss.total_variation`` of a volume (1, nz, ny, nx), so shaped.

    Of a slab it is that of the whole volume, of so many ``planes``, except within ``faint.HALO`` planes of where the
    slab ends. ``largest``, a float32 tensor of one number, is raised to the largest value of the volume.
    """
    by_corners = [1 / corner if corner else 0.0 for corner in corners]
    if planes > 1:
        away = away_from_edges(volume, corners[0], dense)
    else:  # in a slice nothing is faint
        away = torch.zeros_like(volume, dtype=torch.int8)
    grad = torch.empty_like(volume)
    with on_device(volume):
        _variation_kernel[(triton.cdiv(volume.numel(), _BLOCK),)](
            volume, away, grad, largest, *volume.shape[1:], planes, dense, *by_corners,
            FAINT * corners[0] or 1.0, factor, BLOCK=_BLOCK, num_warps=4,
        )  # fmt: skip
    return grad

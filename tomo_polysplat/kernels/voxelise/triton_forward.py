"""Voxelising on CUDA: neighbours in the list are summed brick by brick and added to the volume.

As in the projection, a warp holds GROUP neighbours, one to a lane, finds those that reach a brick of their
common window, sums them in registers and adds the sum atomically: the volume repeats to rounding.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.triton_lanes import (
    add_within,
    lane_set,
    load_four,
    next_lane,
    odd_ranks,
    share_out,
)
from tomo_polysplat.kernels.triton_maths import GROUP, HALF_LOG2E, SIZES, grain, grained, on_device
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.kernels.voxelise.triton_setup import RECORD

__all__ = ["splat"]

_SLICES = 4  # of a brick; with as many columns, and rows so that half a warp has a line a lane
_PROGRAMS = 1 << 15  # enough to fill the device; the windows of fewer groups are each shared out
_MOST_PARTS = 16
_HALF = tl.constexpr(16)
_NOWHERE = tl.constexpr(-1e30)


@triton.jit
def _window(centre, half, live, length):
    """First and last index that the bounding boxes of a group share with an axis."""
    low = tl.maximum(tl.min(tl.where(live, centre - half, -_NOWHERE), 0), 0.0)
    high = tl.minimum(tl.max(tl.where(live, centre + half, _NOWHERE), 0), length - 1.0)
    return tl.math.ceil(tl.minimum(low, length + 0.0)).to(tl.int32), tl.maximum(high, -1.0).to(tl.int32)


@triton.jit
def _columns(
    xc, yc, zc, r11, r12, r13, r22, r23, r33, half_x, live, y, z, nx, cut, H: tl.constexpr, D: tl.constexpr
):
    """First and last column that ellipsoids can reach along a beam of H x D lines around (y, z); -1 is last where none.

    From the least that each of q's other terms, and the farthest that the middle of a line, comes to in the beam:
    never too narrow.
    """
    dy, dz, high, deep = y - yc, z - zc, (H - 1) / 2, (D - 1) / 2
    out = tl.maximum(r33 * (tl.abs(dz) - deep), 0.0)
    up = tl.maximum(tl.abs(r22 * dy + r23 * dz) - (r22 * high + tl.abs(r23) * deep), 0.0)
    # A hundredth more than the cut: rounding must not lose a voxel.
    rest = 1.01 * cut - (up * up + out * out)
    half = (tl.sqrt(tl.maximum(rest, 0.0)) + tl.abs(r12) * high + tl.abs(r13) * deep) / r11
    middle = xc - (r12 * dy + r13 * dz) / r11
    left, right = tl.maximum(middle - half, xc - half_x), tl.minimum(middle + half, xc + half_x)
    there = live & (rest >= 0)
    left = tl.where(there, tl.minimum(tl.maximum(left, 0.0), nx + 0.0), nx + 0.0)
    right = tl.where(there, tl.minimum(tl.maximum(right, -1.0), nx - 1.0), -1.0)
    first, last = tl.math.ceil(left).to(tl.int32), tl.math.floor(right).to(tl.int32)
    return first, tl.where(first <= last, last, -1)


@triton.jit
def _add_value(a0, a1, a2, a3, t, rest, cut, w0, w1, w2, w3, CHANNELS: tl.constexpr):
    """The sums of a voxel with what Gaussians add to it at ``t``."""
    q = t * t + rest
    return add_within(a0, a1, a2, a3, q, cut, tl.exp2(-1.0 * q), w0, w1, w2, w3, CHANNELS)


@triton.jit
def _sum_brick(record, found, odd, upper, x, y, z, cut, CHANNELS: tl.constexpr):
    """Sums of the Gaussians ``found`` at a line of every lane, at four columns from ``x`` on.

    Halves of the warp share out Gaussians and in the end columns as in the projection.
    """
    zero = tl.zeros([32], tl.float32)
    a0, a1, a2, a3, b0, b1, b2, b3 = zero, zero, zero, zero, zero, zero, zero, zero
    c0, c1, c2, c3, d0, d1, d2, d3 = zero, zero, zero, zero, zero, zero, zero, zero
    lanes = tl.where(upper, found & ~odd, odd)
    while odd != 0:
        odd &= odd - 1
        which, limit, lanes = next_lane(lanes, cut)
        at = record + which.to(tl.int64) * RECORD
        cx, cy, cz, r11 = load_four(at)
        r12, r13, r22, r23 = load_four(at + 4)
        r33, _, _, _ = load_four(at + 8)
        w0, w1, w2, w3 = load_four(at + 12)
        dy, dz = y - cy, z - cz
        up, out = r22 * dy + r23 * dz, r33 * dz
        t, rest = r11 * (x - cx) + (r12 * dy + r13 * dz), up * up + out * out
        a0, a1, a2, a3 = _add_value(a0, a1, a2, a3, t, rest, limit, w0, w1, w2, w3, CHANNELS)
        t += r11
        b0, b1, b2, b3 = _add_value(b0, b1, b2, b3, t, rest, limit, w0, w1, w2, w3, CHANNELS)
        t += r11
        c0, c1, c2, c3 = _add_value(c0, c1, c2, c3, t, rest, limit, w0, w1, w2, w3, CHANNELS)
        t += r11
        d0, d1, d2, d3 = _add_value(d0, d1, d2, d3, t, rest, limit, w0, w1, w2, w3, CHANNELS)
    return share_out(a0, b0, c0, d0, a1, b1, c1, d1, a2, b2, c2, d2, a3, b3, c3, d3, CHANNELS)


@triton.jit
def _add(at, sum_, shift, inside, GRAINED: tl.constexpr):
    if GRAINED:
        sum_ = grained(sum_, shift)
    tl.atomic_add(at, sum_, mask=inside & (sum_ != 0), sem="relaxed")


@triton.jit
def _add_voxel(at, stride, inside, v0, v1, v2, v3, shift, CHANNELS: tl.constexpr, GRAINED: tl.constexpr):
    _add(at, v0, shift, inside, GRAINED)
    if CHANNELS > 1:
        _add(at + stride, v1, shift, inside, GRAINED)
    if CHANNELS > 2:
        _add(at + stride + stride, v2, shift, inside, GRAINED)
    if CHANNELS > 3:
        _add(at + stride + stride + stride, v3, shift, inside, GRAINED)


@triton.jit(do_not_specialize=SIZES)
def _splat_voxels_kernel(
    record, volume, largest, count, nz, ny, nx, stride, parts, cut,
    CHANNELS: tl.constexpr, D: tl.constexpr, GROUP: tl.constexpr, GRAINED: tl.constexpr,
):  # fmt: skip
    H: tl.constexpr = _HALF // D
    shift = grain(largest, GRAINED)
    group, part, lane = tl.program_id(0) // parts, tl.program_id(0) % parts, tl.arange(0, GROUP)
    n = group * GROUP + lane
    at = record + tl.minimum(n, count - 1).to(tl.int64) * RECORD
    cx, cy, cz, r11 = load_four(at)
    r12, r13, r22, r23 = load_four(at + 4)
    r33, half_x, half_y, half_z = load_four(at + 8)
    live = (n < count) & (cx + half_x >= 0) & (cx - half_x <= nx - 1)
    y0, y1 = _window(cy, half_y, live, ny)
    z0, z1 = _window(cz, half_z, live, nz)
    if (y0 <= y1) & (z0 <= z1):
        record += group.to(tl.int64) * GROUP * RECORD
        upper, row, slab = lane >= _HALF, lane % _HALF % H, lane % _HALF // H
        down = (y1 - y0) // H + 1
        for beam in range(part, down * ((z1 - z0) // D + 1), parts):
            top, front = y0 + beam % down * H, z0 + beam // down * D
            first, last = _columns(
                cx, cy, cz, r11, r12, r13, r22, r23, r33, half_x, live,
                top + (H - 1) / 2, front + (D - 1) / 2, nx, cut, H, D,
            )  # fmt: skip
            iy, iz = top + row, front + slab
            line = volume + (iz.to(tl.int64) * ny + iy) * nx
            # From a column that four divides: four voxels fill half a sector of memory.
            for left in range(tl.min(first, 0) // 4 * 4, tl.max(last, 0) + 1, 4):
                found = lane_set((first < left + 4) & (last >= left), lane)
                odd = odd_ranks(found)
                if odd != 0:
                    a0, a1, a2, a3, c0, c1, c2, c3 = _sum_brick(
                        record, found, odd, upper, left + 0.0, iy.to(tl.float32), iz.to(tl.float32), cut, CHANNELS,
                    )  # fmt: skip
                    ix = left + upper.to(tl.int32)
                    inside = (ix < nx) & (iy < ny) & (iz < nz)
                    _add_voxel(line + ix, stride, inside, a0, a1, a2, a3, shift, CHANNELS, GRAINED)
                    ix += 2
                    inside &= ix < nx
                    _add_voxel(line + ix, stride, inside, c0, c1, c2, c3, shift, CHANNELS, GRAINED)


def splat(
    record,
    channels: int,
    box: VoxelBox,
    cutoff: float,
    largest: torch.Tensor | None = None,
    volume: torch.Tensor | None = None,
) -> torch.Tensor:
    """Volume (channels, nz, ny, nx) of the ellipsoids; ``largest`` and ``volume`` as in the projection's splat."""
    count = len(record)
    if volume is None:
        volume = record.new_zeros((channels, *box.shape))
    if not (count and volume.numel()):
        return volume
    groups = triton.cdiv(count, GROUP)
    parts = triton.next_power_of_2(max(1, min(_MOST_PARTS, _PROGRAMS // groups)))
    with on_device(record):
        _splat_voxels_kernel[(groups * parts,)](
            record, volume, record if largest is None else largest, count, *box.shape, volume.stride(0),
            parts, cutoff * cutoff * HALF_LOG2E, CHANNELS=channels, D=1 if box.shape[0] == 1 else _SLICES,
            GROUP=GROUP, GRAINED=largest is not None, num_warps=1, num_stages=1,
        )  # fmt: skip
    return volume

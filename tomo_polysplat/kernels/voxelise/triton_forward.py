"""Voxelising on CUDA: neighbours in the list are summed brick by brick and added to the volume.

As in the projection, a warp holds GROUP neighbours, one to a lane, finds those that reach a brick of their
common window, sums them in registers and adds the sum atomically: the volume repeats to rounding.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.triton_lanes import lane_set, load_four, lowest_lane
from tomo_polysplat.kernels.triton_maths import GROUP, HALF_LOG2E, SIZES, dot, grain, grained, on_device
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.kernels.voxelise.triton_setup import RECORD

__all__ = ["BRICK", "splat"]

BRICK = (4, 8, 8)  # slices, rows and columns
_PROGRAMS = 1 << 15  # enough to fill the device; the windows of fewer groups are each shared out
_MOST_PARTS = 16
_NOWHERE = tl.constexpr(-1e30)


@triton.jit
def _window(centre, half, live, length):
    """First and last index that the bounding boxes of a group share with an axis."""
    low = tl.maximum(tl.min(tl.where(live, centre - half, -_NOWHERE), 0), 0.0)
    high = tl.minimum(tl.max(tl.where(live, centre + half, _NOWHERE), 0), length - 1.0)
    return tl.math.ceil(tl.minimum(low, length + 0.0)).to(tl.int32), tl.maximum(high, -1.0).to(tl.int32)


@triton.jit
def _reaches(x, y, z, r11, r12, r13, r22, r23, r33, cut, W: tl.constexpr, H: tl.constexpr, D: tl.constexpr):
    """Whether ellipsoids can meet the brick whose centre lies at (x, y, z) from theirs.

    Seen along the line from the ellipsoid's centre to the brick's, in units where the ellipsoid is a ball of
    radius sqrt(cut), they do not when the ball ends before the brick begins.
    """
    d0, d1, d2 = dot(r11, r12, r13, x, y, z), r22 * y + r23 * z, r33 * z
    square = dot(d0, d1, d2, d0, d1, d2)
    half = tl.abs(r11 * d0) * ((W - 1) / 2) + tl.abs(r12 * d0 + r22 * d1) * ((H - 1) / 2)
    half += tl.abs(dot(r13, r23, r33, d0, d1, d2)) * ((D - 1) / 2)
    # A hundredth more than the cut: rounding must not lose a voxel.
    return square - half <= 1.01 * tl.sqrt(cut * square)


@triton.jit
def _sum_brick(record, found, x, y, z, cut, CHANNELS: tl.constexpr):
    """Sums of the Gaussians ``found`` over a brick, (columns, lines): so a lane has voxels of one line."""
    sum0 = tl.zeros_like(x + y)
    sum1, sum2, sum3 = sum0, sum0, sum0
    while found != 0:
        at = record + lowest_lane(found) * RECORD
        found &= found - 1
        cx, cy, cz, r11 = load_four(at)
        r12, r13, r22, r23 = load_four(at + 4)
        r33, _, _, _ = load_four(at + 8)
        w0, w1, w2, w3 = load_four(at + 12)
        dx, dy, dz = x - cx, y - cy, z - cz
        up, out = r22 * dy + r23 * dz, r33 * dz
        t = r11 * dx + (r12 * dy + r13 * dz)
        q = t * t + (up * up + out * out)
        value = tl.where(q <= cut, tl.exp2(-1.0 * q), 0.0)
        sum0 += w0 * value
        if CHANNELS > 1:
            sum1 += w1 * value
        if CHANNELS > 2:
            sum2 += w2 * value
        if CHANNELS > 3:
            sum3 += w3 * value
    return sum0, sum1, sum2, sum3


@triton.jit(do_not_specialize=SIZES)
def _splat_kernel(
    record, volume, largest, count, nz, ny, nx, stride, parts, cut,
    CHANNELS: tl.constexpr, D: tl.constexpr, H: tl.constexpr, W: tl.constexpr,
    GROUP: tl.constexpr, GRAINED: tl.constexpr,
):  # fmt: skip
    shift = grain(largest, GRAINED)
    group, part, lane = tl.program_id(0) // parts, tl.program_id(0) % parts, tl.arange(0, GROUP)
    n = group * GROUP + lane
    at = record + tl.minimum(n, count - 1).to(tl.int64) * RECORD
    cx, cy, cz, r11 = load_four(at)
    r12, r13, r22, r23 = load_four(at + 4)
    r33, half_x, half_y, half_z = load_four(at + 8)
    live = n < count
    x0, x1 = _window(cx, half_x, live, nx)
    y0, y1 = _window(cy, half_y, live, ny)
    z0, z1 = _window(cz, half_z, live, nz)
    if (x0 <= x1) & (y0 <= y1) & (z0 <= z1):
        record += group.to(tl.int64) * GROUP * RECORD
        x0 = x0 // 8 * 8  # eight voxels fill a sector of memory
        across, down = (x1 - x0) // W + 1, (y1 - y0) // H + 1
        line = tl.arange(0, D * H)[None, :]
        for brick in range(part, across * down * ((z1 - z0) // D + 1), parts):
            slab = brick // across
            left, top, front = x0 + brick % across * W, y0 + slab % down * H, z0 + slab // down * D
            x, y, z = left + (W - 1) / 2 - cx, top + (H - 1) / 2 - cy, front + (D - 1) / 2 - cz
            found = lane_set(live & _reaches(x, y, z, r11, r12, r13, r22, r23, r33, cut, W, H, D), lane)
            if found != 0:
                ix, iy, iz = left + tl.arange(0, W)[:, None], top + line % H, front + line // H
                sum0, sum1, sum2, sum3 = _sum_brick(
                    record, found, ix.to(tl.float32), iy.to(tl.float32), iz.to(tl.float32), cut, CHANNELS
                )
                if GRAINED:
                    sum0, sum1 = grained(sum0, shift), grained(sum1, shift)
                    sum2, sum3 = grained(sum2, shift), grained(sum3, shift)
                inside = (ix < nx) & (iy < ny) & (iz < nz)
                voxel = volume + ((iz.to(tl.int64) * ny + iy) * nx + ix)
                tl.atomic_add(voxel, sum0, mask=inside & (sum0 != 0), sem="relaxed")
                if CHANNELS > 1:
                    voxel += stride
                    tl.atomic_add(voxel, sum1, mask=inside & (sum1 != 0), sem="relaxed")
                if CHANNELS > 2:
                    voxel += stride
                    tl.atomic_add(voxel, sum2, mask=inside & (sum2 != 0), sem="relaxed")
                if CHANNELS > 3:
                    voxel += stride
                    tl.atomic_add(voxel, sum3, mask=inside & (sum3 != 0), sem="relaxed")


def splat(
    record, channels: int, box: VoxelBox, cutoff: float, largest: torch.Tensor | None = None
) -> torch.Tensor:
    """Volume (channels, nz, ny, nx) of the ellipsoids; with ``largest`` as in the projection's, to the bit."""
    count = len(record)
    volume = record.new_zeros((channels, *box.shape))
    if not (count and volume.numel()):
        return volume
    groups = triton.cdiv(count, GROUP)
    parts = triton.next_power_of_2(max(1, min(_MOST_PARTS, _PROGRAMS // groups)))
    with on_device(record):
        _splat_kernel[(groups * parts,)](
            record, volume, record if largest is None else largest, count, *box.shape, volume.stride(0),
            parts, cutoff * cutoff * HALF_LOG2E, CHANNELS=channels, D=BRICK[0], H=BRICK[1], W=BRICK[2],
            GROUP=GROUP, GRAINED=largest is not None, num_warps=1, num_stages=1,
        )  # fmt: skip
    return volume

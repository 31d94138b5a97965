"""Voxelising on CUDA: every brick of voxels gathers the Gaussians that reach it.

As in the projection, a brick finds them through the bounding boxes of groups of neighbours in the list, so
there are no atomics and every run gives the same bits.
"""

from __future__ import annotations

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

from tomo_polysplat.kernels.triton_maths import GROUP, HALF_LOG2E, dot, lane_set, lowest_lane, on_device
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.kernels.voxelise.triton_setup import RECORD

__all__ = ["BRICK", "gather_volume"]

BRICK = (4, 4, 8)  # slices, rows and columns of a brick, handled by one warp


@triton.jit
def _reaches(shape, n, count, x, y, z, cut, WIDE: tl.constexpr, HIGH: tl.constexpr, DEEP: tl.constexpr):
    """Whether the ellipsoids of the Gaussians ``n`` can meet the brick centred at (x, y, z).

    Seen along the line from the ellipsoid's centre to the brick's, in units where the ellipsoid is a ball of
    radius sqrt(cut), they do not when the ball ends before the brick begins.
    """
    live = n < count
    x -= tl.load(shape + n, mask=live, other=0.0)
    y -= tl.load(shape + count + n, mask=live, other=0.0)
    z -= tl.load(shape + 2 * count + n, mask=live, other=0.0)
    r11 = tl.load(shape + 3 * count + n, mask=live, other=0.0)
    r12 = tl.load(shape + 4 * count + n, mask=live, other=0.0)
    r13 = tl.load(shape + 5 * count + n, mask=live, other=0.0)
    r22 = tl.load(shape + 6 * count + n, mask=live, other=0.0)
    r23 = tl.load(shape + 7 * count + n, mask=live, other=0.0)
    r33 = tl.load(shape + 8 * count + n, mask=live, other=0.0)
    d0, d1, d2 = dot(r11, r12, r13, x, y, z), r22 * y + r23 * z, r33 * z
    square = dot(d0, d1, d2, d0, d1, d2)
    half = tl.abs(r11 * d0) * ((WIDE - 1) / 2) + tl.abs(r12 * d0 + r22 * d1) * ((HIGH - 1) / 2)
    half += tl.abs(dot(r13, r23, r33, d0, d1, d2)) * ((DEEP - 1) / 2)
    # A hundredth more than the cut: rounding must not lose a voxel.
    return live & (square - half <= 1.01 * tl.sqrt(cut * square))


@triton.jit
def _gather_kernel(
    record, shape, boxes, volume, count, groups, nz, ny, nx, stride, cut,
    CHANNELS: tl.constexpr, DEEP: tl.constexpr, HIGH: tl.constexpr, WIDE: tl.constexpr, GROUP: tl.constexpr,
):  # fmt: skip
    across, down = tl.cdiv(nx, WIDE), tl.cdiv(ny, HIGH)
    brick = tl.program_id(0)
    x0, y0 = (brick % across) * WIDE, (brick // across % down) * HIGH
    z0 = brick // across // down * DEEP
    lane, line = tl.arange(0, GROUP), tl.arange(0, DEEP * HIGH)
    ix, iy, iz = x0 + tl.arange(0, WIDE), y0 + line % HIGH, z0 + line // HIGH
    fx, fy, fz = ix.to(tl.float32)[None, :], iy.to(tl.float32)[:, None], iz.to(tl.float32)[:, None]
    left, top, front = x0.to(tl.float32), y0.to(tl.float32), z0.to(tl.float32)
    sum0 = tl.zeros([DEEP * HIGH, WIDE], tl.float32)
    sum1, sum2, sum3 = sum0, sum0, sum0
    for first in range(0, groups, GROUP):
        box, known = boxes + first + lane, first + lane < groups
        meets = (tl.load(box, mask=known, other=0.0) <= left + (WIDE - 1)) & known
        meets &= tl.load(box + groups, mask=known, other=0.0) <= top + (HIGH - 1)
        meets &= tl.load(box + 2 * groups, mask=known, other=0.0) <= front + (DEEP - 1)
        meets &= tl.load(box + 3 * groups, mask=known, other=0.0) >= left
        meets &= tl.load(box + 4 * groups, mask=known, other=0.0) >= top
        meets &= tl.load(box + 5 * groups, mask=known, other=0.0) >= front
        near = lane_set(meets, lane)
        while near != 0:
            start = (first + lowest_lane(near)) * GROUP
            near &= near - 1
            x, y, z = left + (WIDE - 1) / 2, top + (HIGH - 1) / 2, front + (DEEP - 1) / 2
            hit = _reaches(shape, start + lane, count, x, y, z, cut, WIDE, HIGH, DEEP)
            found = lane_set(hit, lane)
            while found != 0:
                at = record + (start + lowest_lane(found)).to(tl.int64) * RECORD
                found &= found - 1
                dx, dy, dz = fx - tl.load(at), fy - tl.load(at + 1), fz - tl.load(at + 2)
                t = tl.load(at + 3) * dx + (tl.load(at + 4) * dy + tl.load(at + 5) * dz)
                up, out = tl.load(at + 6) * dy + tl.load(at + 7) * dz, tl.load(at + 8) * dz
                minus = -(up * up + out * out) - t * t
                value = tl.where(minus >= -cut, tl.exp2(minus), 0.0)
                sum0 += tl.load(at + 12) * value
                if CHANNELS > 1:
                    sum1 += tl.load(at + 13) * value
                if CHANNELS > 2:
                    sum2 += tl.load(at + 14) * value
                if CHANNELS > 3:
                    sum3 += tl.load(at + 15) * value
    inside = ((iz < nz) & (iy < ny))[:, None] & (ix < nx)[None, :]
    voxel = volume + ((iz.to(tl.int64) * ny + iy) * nx)[:, None] + ix[None, :]
    tl.store(voxel, sum0, mask=inside)
    if CHANNELS > 1:
        voxel += stride
        tl.store(voxel, sum1, mask=inside)
    if CHANNELS > 2:
        voxel += stride
        tl.store(voxel, sum2, mask=inside)
    if CHANNELS > 3:
        voxel += stride
        tl.store(voxel, sum3, mask=inside)


def gather_volume(record, shape, boxes, channels: int, box: VoxelBox, cutoff: float) -> torch.Tensor:
    """Volume (channels, nz, ny, nx) of the ellipsoids."""
    count, (nz, ny, nx) = len(record), box.shape
    if not count:
        return record.new_zeros((channels, *box.shape))
    volume = record.new_empty((channels, *box.shape))
    bricks = triton.cdiv(nz, BRICK[0]) * triton.cdiv(ny, BRICK[1]) * triton.cdiv(nx, BRICK[2])
    if bricks:
        with on_device(record):
            _gather_kernel[(bricks,)](
                record, shape, boxes, volume, count, boxes.shape[1], nz, ny, nx, volume.stride(0),
                cutoff * cutoff * HALF_LOG2E, CHANNELS=channels, DEEP=BRICK[0], HIGH=BRICK[1], WIDE=BRICK[2],
                GROUP=GROUP, num_warps=1, num_stages=1,
            )  # fmt: skip
    return volume

"""What Triton's language lacks: four numbers moved at once, and the sums of many numbers over a warp.

Each is a line of PTX on the device. Triton's interpreter has no PTX, so there the same is said in Triton.
"""

from __future__ import annotations

import functools
import os

import torch
import triton  # noqa: TID253 - imported only where a kernel runs
import triton.language as tl  # noqa: TID253

__all__ = [
    "SUMS",
    "add_four",
    "add_halves",
    "add_within",
    "adds_four",
    "by_size",
    "from_lane",
    "lane_set",
    "load_four",
    "lowest_lane",
    "next_lane",
    "odd_ranks",
    "share_out",
    "store_four",
    "store_sums",
    "widest",
]

SUMS = tl.constexpr(16)  # tensors that store_sums takes
# The only switch Triton has; it is read once, when the kernels are defined.
_INTERPRETED = tl.constexpr(os.environ.get("TRITON_INTERPRET", "0") == "1")


@functools.cache
def adds_four(device: torch.device) -> bool:
    """Whether the device adds four floats to memory in one instruction (compute capability 9.0)."""
    return device.type == "cuda" and torch.cuda.get_device_capability(device)[0] >= 9


@triton.jit
def load_four(at):
    """The four floats at ``at``, which must be 16-byte aligned and written by an earlier kernel."""
    if _INTERPRETED:
        return tl.load(at), tl.load(at + 1), tl.load(at + 2), tl.load(at + 3)
    return tl.inline_asm_elementwise(
        "ld.global.nc.v4.f32 {$0, $1, $2, $3}, [$4];", "=f,=f,=f,=f,l", [at.to(tl.int64)],
        dtype=(tl.float32, tl.float32, tl.float32, tl.float32), is_pure=True, pack=1,
    )  # fmt: skip


@triton.jit
def store_four(at, a, b, c, d, live):
    """Store four floats at ``at``, 16-byte aligned, where ``live``."""
    if _INTERPRETED:
        tl.store(at, a, mask=live)
        tl.store(at + 1, b, mask=live)
        tl.store(at + 2, c, mask=live)
        tl.store(at + 3, d, mask=live)
    else:
        tl.inline_asm_elementwise(
            "{ .reg .pred p; setp.ne.s32 p, $6, 0; @p st.global.v4.f32 [$1], {$2, $3, $4, $5}; mov.u32 $0, 0; }",
            "=r,l,f,f,f,f,r", [at.to(tl.int64), a, b, c, d, live.to(tl.int32)],
            dtype=tl.int32, is_pure=False, pack=1,
        )  # fmt: skip


@triton.jit
def add_four(at, a, b, c, d, live, AT_ONCE: tl.constexpr):
    """Add four floats atomically to those at ``at``, 16-byte aligned, where ``live``."""
    if AT_ONCE:
        tl.inline_asm_elementwise(
            "{ .reg .pred p; setp.ne.s32 p, $6, 0;"
            " @p red.relaxed.gpu.global.add.v4.f32 [$1], {$2, $3, $4, $5}; mov.u32 $0, 0; }",
            "=r,l,f,f,f,f,r", [at.to(tl.int64), a, b, c, d, live.to(tl.int32)],
            dtype=tl.int32, is_pure=False, pack=1,
        )  # fmt: skip
    else:
        tl.atomic_add(at, a, mask=live, sem="relaxed")
        tl.atomic_add(at + 1, b, mask=live, sem="relaxed")
        tl.atomic_add(at + 2, c, mask=live, sem="relaxed")
        tl.atomic_add(at + 3, d, mask=live, sem="relaxed")


def _butterfly(lanes: int) -> str:
    """PTX that adds up 16 numbers over neighbouring ``lanes``: each gets as many of the sums, in their order.

    In every step a lane hands half of its numbers to its partner and takes the partner's share of the other
    half: for four lanes 12 exchanges do what 32 would do one number at a time.
    """
    registers = ", ".join(f"v{k}" for k in range(SUMS.value))
    lines = [
        f"{{ .reg .pred p; .reg .b32 lane, bit; .reg .f32 give, keep, {registers}; mov.u32 lane, %laneid;"
    ]
    half, partner = SUMS.value, lanes
    lines += [f"mov.f32 v{k}, ${k + half // lanes};" for k in range(half)]
    while partner > 1:
        half, partner = half // 2, partner // 2
        lines.append(f"and.b32 bit, lane, {partner}; setp.ne.u32 p, bit, 0;")
        for k in range(half):
            lines.append(f"selp.f32 give, v{k}, v{k + half}, p; selp.f32 keep, v{k + half}, v{k}, p;")
            lines.append(f"shfl.sync.bfly.b32 give, give, {partner}, 31, -1; add.f32 v{k}, keep, give;")
    return " ".join([*lines, *(f"mov.f32 ${k}, v{k};" for k in range(half)), "}"])


def _butterfly_types(lanes: int) -> str:
    return ",".join(["=f"] * (SUMS.value // lanes) + ["f"] * SUMS.value)


_OVER_TWO, _OVER_FOUR = tl.constexpr(_butterfly(2)), tl.constexpr(_butterfly(4))
_TYPES_OF_TWO, _TYPES_OF_FOUR = tl.constexpr(_butterfly_types(2)), tl.constexpr(_butterfly_types(4))


@triton.jit
def store_sums(
    at, live, lane, v0, v1, v2, v3, v4, v5, v6, v7, v8, v9, v10, v11, v12, v13, v14, v15, LANES: tl.constexpr
):
    """Store at ``at``, where ``live``, the 16 numbers summed over 2 or 4 neighbouring LANES of a one-warp program.

    These lanes have one ``at``, 16-byte aligned.
    """
    if _INTERPRETED:
        values = (v0, v1, v2, v3, v4, v5, v6, v7, v8, v9, v10, v11, v12, v13, v14, v15)
        for k in tl.static_range(16):
            total = tl.sum(tl.reshape(values[k], (32 // LANES, LANES)), 1)[:, None]
            total = tl.reshape(tl.broadcast_to(total, (32 // LANES, LANES)), (32,))
            tl.store(at + k, total, mask=live & (lane % LANES == 0))
    elif LANES == 4:
        s0, s1, s2, s3 = tl.inline_asm_elementwise(
            _OVER_FOUR, _TYPES_OF_FOUR,
            [v0, v1, v2, v3, v4, v5, v6, v7, v8, v9, v10, v11, v12, v13, v14, v15],
            dtype=(tl.float32, tl.float32, tl.float32, tl.float32), is_pure=False, pack=1,
        )  # fmt: skip
        store_four(at + 4 * (lane % 4), s0, s1, s2, s3, live)
    else:
        s0, s1, s2, s3, s4, s5, s6, s7 = tl.inline_asm_elementwise(
            _OVER_TWO, _TYPES_OF_TWO,
            [v0, v1, v2, v3, v4, v5, v6, v7, v8, v9, v10, v11, v12, v13, v14, v15],
            dtype=(
                tl.float32, tl.float32, tl.float32, tl.float32,
                tl.float32, tl.float32, tl.float32, tl.float32,
            ), is_pure=False, pack=1,
        )  # fmt: skip
        store_four(at + 8 * (lane % 2), s0, s1, s2, s3, live)
        store_four(at + 8 * (lane % 2) + 4, s4, s5, s6, s7, live)


def _sort() -> str:
    """PTX that sorts 64 non-negative integers, two to a lane: a bitonic network, the second 32 after the first."""
    lines = [
        "{ .reg .pred p, q; .reg .b32 lane, bit, c, d, x, y; mov.u32 lane, %laneid; mov.b32 c, $2; mov.b32 d, $3;"
    ]
    size = 2
    while size <= 64:
        step = size // 2
        while step:
            if step == 32:
                lines.append("min.s32 x, c, d; max.s32 d, c, d; mov.b32 c, x;")
            else:
                # The lower lane of two keeps the smaller one, or the larger in every second run of ``size``.
                lines.append(f"and.b32 bit, lane, {step}; setp.eq.u32 p, bit, 0;")
                if size < 32:
                    lines.append(f"and.b32 bit, lane, {size}; setp.ne.u32 q, bit, 0; xor.pred p, p, q;")
                for v in "cd":
                    lines.append(f"shfl.sync.bfly.b32 x, {v}, {step}, 31, -1;")
                    lines.append(f"min.s32 y, {v}, x; max.s32 x, {v}, x; selp.b32 {v}, y, x, p;")
                    if size == 32:  # the second 32 descend, so that with the first they make one bitonic run
                        lines.append("not.pred p, p;")
            step //= 2
        size *= 2
    return " ".join([*lines, "mov.b32 $0, c; mov.b32 $1, d; }"])


_SORT = tl.constexpr(_sort())


@triton.jit
def by_size(a, b, lane):
    """Which of 64 numbers come in order, the first 32 and the last, by ``a`` and ``b``: not negative, 18 bits count."""
    a, b = (a.to(tl.int32, bitcast=True) & -64) | lane, (b.to(tl.int32, bitcast=True) & -64) | (lane + 32)
    if _INTERPRETED:
        both = tl.sort(tl.reshape(tl.permute(tl.join(a, b), (1, 0)), (64,)))
        a, b = tl.split(tl.permute(tl.reshape(both, (2, 32)), (1, 0)))
    else:
        a, b = tl.inline_asm_elementwise(
            _SORT, "=&r,=&r,r,r", [a, b], dtype=(tl.int32, tl.int32), is_pure=False, pack=1
        )
    return a & 63, b & 63


@triton.jit
def from_lane(value, lane):
    """What other lanes of a one-warp program have."""
    if _INTERPRETED:
        return tl.gather(value, lane, 0)
    return tl.inline_asm_elementwise(
        "shfl.sync.idx.b32 $0, $1, $2, 31, -1;", "=r,r,r", [value, lane], dtype=tl.int32, is_pure=False, pack=1
    )  # fmt: skip


@triton.jit
def widest(low, high):
    """The lower ``low`` and the higher ``high`` of two neighbouring lanes of a one-warp program."""
    if _INTERPRETED:
        low, high = (
            tl.min(tl.reshape(low, (16, 2)), 1)[:, None],
            tl.max(tl.reshape(high, (16, 2)), 1)[:, None],
        )
        low, high = tl.broadcast_to(low, (16, 2)), tl.broadcast_to(high, (16, 2))
        return tl.reshape(low, (32,)), tl.reshape(high, (32,))
    return tl.inline_asm_elementwise(
        "{ .reg .f32 other; shfl.sync.bfly.b32 other, $2, 1, 31, -1; min.f32 $0, $2, other;"
        " shfl.sync.bfly.b32 other, $3, 1, 31, -1; max.f32 $1, $3, other; }",
        "=&f,=&f,f,f", [low, high], dtype=(tl.float32, tl.float32), is_pure=False, pack=1,
    )  # fmt: skip


@triton.jit
def add_halves(a, b):
    """In the lower half of a one-warp program's lanes the sums of both halves of ``a``, in the upper those of ``b``."""
    if _INTERPRETED:
        sum_a, sum_b = tl.sum(tl.reshape(a, (2, 16)), 0)[None, :], tl.sum(tl.reshape(b, (2, 16)), 0)[None, :]
        return tl.reshape(tl.where(tl.arange(0, 2)[:, None] == 0, sum_a, sum_b), (32,))
    return tl.inline_asm_elementwise(
        "{ .reg .pred p; .reg .b32 lane; .reg .f32 give, keep; mov.u32 lane, %laneid; setp.gt.u32 p, lane, 15;"
        " selp.f32 give, $1, $2, p; selp.f32 keep, $2, $1, p;"
        " shfl.sync.bfly.b32 give, give, 16, 31, -1; add.f32 $0, keep, give; }",
        "=f,f,f", [a, b], dtype=tl.float32, is_pure=False, pack=1,
    )  # fmt: skip


@triton.jit
def share_out(
    a0, b0, c0, d0, a1, b1, c1, d1, a2, b2, c2, d2, a3, b3, c3, d3, CHANNELS: tl.constexpr
):  # fmt: skip
    """Sums over both halves of the warp, by channel; the lower half keeps a's and c's, the upper b's and d's."""
    a0, c0 = add_halves(a0, b0), add_halves(c0, d0)
    if CHANNELS > 1:
        a1, c1 = add_halves(a1, b1), add_halves(c1, d1)
    if CHANNELS > 2:
        a2, c2 = add_halves(a2, b2), add_halves(c2, d2)
    if CHANNELS > 3:
        a3, c3 = add_halves(a3, b3), add_halves(c3, d3)
    return a0, a1, a2, a3, c0, c1, c2, c3


@triton.jit
def lane_set(hit, lane):
    """The set of the 32 lanes where ``hit``, as bits of one integer that every lane knows."""
    return tl.sum(tl.where(hit, 1 << lane, 0), 0).to(tl.int32)


@triton.jit
def lowest_lane(lanes):
    """The lowest bit set in ``lanes``."""
    lowest = lanes & -lanes
    if _INTERPRETED:  # the exponent of that power of two as a float
        return ((lowest.to(tl.float32).to(tl.int32, bitcast=True) >> 23) & 255) - 127
    return tl.inline_asm_elementwise(
        "bfind.u32 $0, $1;", "=r,r", [lowest], dtype=tl.int32, is_pure=True, pack=1
    )


@triton.jit
def odd_ranks(lanes):
    """Every other bit that is set in ``lanes``: the lowest, the third lowest and so on."""
    # Each bit becomes the parity of how many are set up to it.
    odd = lanes ^ (lanes << 1)
    odd ^= odd << 2
    odd ^= odd << 4
    odd ^= odd << 8
    odd ^= odd << 16
    return lanes & odd


@triton.jit
def next_lane(lanes, cut):
    """The lowest bit set in each of ``lanes`` with ``cut``, and the bits left; 0 and -1, below any q, where none is."""
    lowest = lanes & -lanes
    which = tl.maximum(lowest_lane(lowest), 0)
    return which, tl.where(lanes != 0, cut, -1.0), lanes ^ lowest


@triton.jit
def add_where(total, q, cut, value, weight):
    """``total``, with ``weight`` times ``value`` where ``q`` is no more than ``cut``: a product under a condition."""
    if _INTERPRETED:
        return tl.where(q <= cut, total + weight * value, total)
    return tl.inline_asm_elementwise(
        "{ .reg .pred p; setp.le.f32 p, $2, $3; mov.f32 $0, $1; @p fma.rn.f32 $0, $4, $5, $0; }",
        "=&f,f,f,f,f,f", [total, q, cut, value, weight], dtype=tl.float32, is_pure=True, pack=1,
    )  # fmt: skip


@triton.jit
def add_within(a0, a1, a2, a3, q, cut, value, w0, w1, w2, w3, CHANNELS: tl.constexpr):
    """The sums of each channel, with its weight times ``value`` where ``q`` is no more than ``cut``."""
    a0 = add_where(a0, q, cut, value, w0)
    if CHANNELS > 1:
        a1 = add_where(a1, q, cut, value, w1)
    if CHANNELS > 2:
        a2 = add_where(a2, q, cut, value, w2)
    if CHANNELS > 3:
        a3 = add_where(a3, q, cut, value, w3)
    return a0, a1, a2, a3

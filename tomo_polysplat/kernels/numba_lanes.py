"""Steps on blocks of ``LANES`` neighbouring float32 numbers, each one vector instruction or a few.

The compiler cannot know that two arrays do not overlap, and so does such loops number by number; these say so.
No index is checked: the caller keeps every block inside its array.
"""

from __future__ import annotations

from typing import Any

from llvmlite import ir
from numba import types
from numba.extending import intrinsic

__all__ = ["LANES", "add_product", "add_scaled", "lane_sums"]

LANES = 16

_VECTOR = ir.VectorType(ir.FloatType(), LANES)
_INDICES = ir.VectorType(ir.IntType(32), LANES)
_FLAGS = ("contract",)

# Its type hints count the typing context among the arguments of a call.
_intrinsic: Any = intrinsic


def _pointer(context, builder, array_type, array, start):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [start]), _VECTOR.as_pointer())


def _accumulate(builder, target, a, b):
    product = builder.fmul(a, b, flags=_FLAGS)
    builder.store(builder.fadd(builder.load(target, align=4), product, flags=_FLAGS), target, align=4)


@_intrinsic
def add_scaled(typing, target, target_start, factor, source, source_start):
    """``target[t : t + LANES] += factor * source[s : s + LANES]`` of the flattened, C-contiguous arrays."""

    def generate(context, builder, signature, values):
        t, s = (_pointer(context, builder, signature.args[k], values[k], values[k + 1]) for k in (0, 3))
        one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), values[2], ir.IntType(32)(0))
        everywhere = builder.shuffle_vector(one, one, ir.Constant(_INDICES, None))
        _accumulate(builder, t, everywhere, builder.load(s, align=4))
        return context.get_dummy_value()

    return types.void(target, types.intp, types.float32, source, types.intp), generate


@_intrinsic
def add_product(typing, target, target_start, a, a_start, b, b_start):
    """``target[t : t + LANES] += a[i : i + LANES] * b[j : j + LANES]``, likewise."""

    def generate(context, builder, signature, values):
        t, i, j = (_pointer(context, builder, signature.args[k], values[k], values[k + 1]) for k in (0, 2, 4))
        _accumulate(builder, t, builder.load(i, align=4), builder.load(j, align=4))
        return context.get_dummy_value()

    return types.void(target, types.intp, a, types.intp, b, types.intp), generate


@_intrinsic
def lane_sums(typing, target, target_start, source, source_start):
    """Sums of ``LANES`` blocks: ``target[t + k] = sum(source[s + k LANES : s + (k + 1) LANES])``, likewise.

    Two vectors at a time become one that holds sums of half as many lanes of either: 15 steps, where to add up the
    lanes of one vector after the other takes 64.
    """

    def generate(context, builder, signature, values):
        t, s = (_pointer(context, builder, signature.args[k], values[k], values[k + 1]) for k in (0, 2))
        vectors = [
            builder.load(builder.gep(s, [ir.Constant(ir.IntType(32), k)]), align=4) for k in range(LANES)
        ]
        half = LANES // 2
        while half:
            lower = [k for k in range(2 * LANES) if k // half % 2 == 0]
            parts = [ir.Constant(_INDICES, [k + shift for k in lower]) for shift in (0, half)]
            vectors = [
                builder.fadd(*(builder.shuffle_vector(*pair, part) for part in parts))
                for pair in zip(vectors[::2], vectors[1::2])
            ]
            half //= 2
        builder.store(vectors[0], t, align=4)
        return context.get_dummy_value()

    return types.void(target, types.intp, source, types.intp), generate

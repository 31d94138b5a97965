"""``LANES`` float32 numbers as one value of a compiled function, which stays in vector registers.

The compiler takes a loop over numbers side by side into vectors only where it can prove much of it, and what it took so
it holds in memory from one loop to the next. These say it, and are compiled sooner than such a loop.

A value knows ``+``, ``-``, ``*`` and ``/``, with others and with single float32 numbers. Its two halves may lie in
different places, as two short rows of an image: so the arrays' blocks are halves, too. No index is checked: the caller
keeps every block inside its array.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir
from llvmlite.binding import get_host_cpu_features
from numba import types
from numba.core.cgutils import for_range_slice, get_or_insert_function
from numba.extending import intrinsic, lower_builtin, models, register_model, type_callable

__all__ = [
    "HALF",
    "LANES",
    "FOLDED",
    "TASK",
    "add_blocks",
    "ceiling",
    "fetch",
    "floor",
    "larger",
    "smaller",
    "halves",
    "inverse_root",
    "lane_sums",
    "load",
    "load_blocks",
    "logarithm",
    "padded",
    "power_of_two",
    "ramp",
    "store",
    "store_folded",
    "tasks_of_lanes",
    "within",
]

# Without AVX-512 sixteen lanes are two vectors of eight, and the sums of a footprint more than there are registers.
LANES = 16 if get_host_cpu_features().get("avx512f") else 8
HALF = LANES // 2
TASK = 1 << 15  # numbers that are worth a thread
FOLDED = 4  # numbers that a sum over pixels is stored as

_FLOAT, _INT = ir.FloatType(), ir.IntType(32)
_BYTE, _LINE = ir.IntType(8), 64  # bytes of a line of a cache
_VECTOR, _BLOCK, _EIGHT = (ir.VectorType(_FLOAT, count) for count in (LANES, HALF, 8))
_INTS = ir.VectorType(_INT, LANES)
_FLAGS = ("contract",)
# The least number that a root is taken of: rounding might make a sum of squares negative.
_LEAST = 1e-20
# Added to a number below 2^22 in size, it leaves the nearest integer in the last bits.
_SHIFT = 1.5 * 2.0**23
# 2^f for -1/2 <= f <= 1/2, from f^5 down: of the polynomials that are 1 at 0, the one closest there (9e-8 relative).
_POWERS = (0.0013264727, 0.0096715126, 0.055507337, 0.24022242, 0.69314698, 1.0)
# The bits of 2/3, and 2 / k from k = 11 down: log((1 + s) / (1 - s)) = 2 s + 2 s^3 / 3 + ...
_TWO_THIRDS = 0x3F2AAAAB
_ODD = tuple(2 / k for k in (11, 9, 7, 5, 3, 1))

# Their type hints count the typing context among the arguments of a call.
_intrinsic: Any = intrinsic


class _Lanes(types.Type):
    def __init__(self) -> None:
        super().__init__(name="Lanes")


_lanes = _Lanes()


@register_model(_Lanes)
class _Model(models.PrimitiveModel):
    def __init__(self, manager: Any, kind: Any) -> None:
        super().__init__(manager, kind, _VECTOR)


def _all(number: float, of: ir.VectorType = _VECTOR) -> ir.Constant:
    return ir.Constant(of, [number] * of.count)


def _spread(builder: Any, value: Any) -> Any:
    """A single number in all lanes; lanes as they are."""
    if value.type == _VECTOR:
        return value
    one = builder.insert_element(ir.Constant(_VECTOR, ir.Undefined), value, _INT(0))
    return builder.shuffle_vector(one, one, ir.Constant(_INTS, None))


def _operator(function: Callable[..., Any], name: str) -> None:
    """Have the compiler know an operator between lanes, and between lanes and a float32."""

    @type_callable(function)
    def type_of(context: Any) -> Any:
        def typer(a: Any, b: Any) -> Any:
            kinds = {a, b}
            return _lanes if kinds <= {_lanes, types.float32} and _lanes in kinds else None

        return typer

    def generate(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        a, b = (_spread(builder, value) for value in values)
        return getattr(builder, name)(a, b, flags=_FLAGS)

    for pair in ((_Lanes, _Lanes), (_Lanes, types.Float), (types.Float, _Lanes)):
        lower_builtin(function, *pair)(generate)


_operator(operator.add, "fadd")
_operator(operator.sub, "fsub")
_operator(operator.mul, "fmul")
_operator(operator.truediv, "fdiv")


def tasks_of_lanes(count: int) -> list[tuple[int, int]]:
    """Runs of ``TASK`` numbers and a rest, the same for any number of threads."""
    return [(start, min(start + TASK, count)) for start in range(0, count, TASK)]


def padded(array: np.ndarray) -> np.ndarray:
    """The array, C-contiguous, with zeros behind its last axis where that has fewer numbers than there are lanes."""
    missing = LANES - array.shape[-1]
    if missing > 0:
        array = np.pad(array, [*[(0, 0)] * (array.ndim - 1), (0, missing)])
    return np.ascontiguousarray(array)


def _pointer(context, builder, array_type, array, start, kind=_VECTOR):
    data = context.make_array(array_type)(context, builder, array).data
    return builder.bitcast(builder.gep(data, [start]), kind.as_pointer())


def _accumulate(builder, target, a, b):
    product = builder.fmul(a, b, flags=_FLAGS)
    builder.store(builder.fadd(builder.load(target, align=4), product, flags=_FLAGS), target, align=4)


def _mask(numbers: Any) -> ir.Constant:
    numbers = list(numbers)
    return ir.Constant(ir.VectorType(_INT, len(numbers)), numbers)


def _joined(builder, low, high):
    return builder.shuffle_vector(low, high, _mask(range(LANES)))


@_intrinsic
def ramp(typing):
    """0, 1, 2, ... in either half."""

    def generate(context, builder, signature, values):
        return ir.Constant(_VECTOR, [float(k % HALF) for k in range(LANES)])

    return _lanes(), generate


@_intrinsic
def halves(typing, low, high):
    """``low`` in the first half of the lanes and ``high`` in the second."""

    def generate(context, builder, signature, values):
        low, high = (_spread(builder, value) for value in values)
        return builder.shuffle_vector(low, high, _mask([k + (k // HALF) * LANES for k in range(LANES)]))

    return _lanes(types.float32, types.float32), generate


@_intrinsic
def load(typing, array, start):
    """``array[start : start + LANES]`` of the flattened, C-contiguous float32 array."""

    def generate(context, builder, signature, values):
        return builder.load(_pointer(context, builder, signature.args[0], *values), align=4)

    return _lanes(array, types.intp), generate


@_intrinsic
def store(typing, array, start, value):
    """Write what `load` reads; to an array of float64 as such."""
    double = array.dtype == types.float64

    def generate(context, builder, signature, values):
        kind = ir.VectorType(ir.DoubleType(), LANES) if double else _VECTOR
        array, start, value = values
        value = builder.fpext(value, kind) if double else value
        pointer = _pointer(context, builder, signature.args[0], array, start, kind)
        builder.store(value, pointer, align=8 if double else 4)
        return context.get_dummy_value()

    return types.void(array, types.intp, _lanes), generate


@_intrinsic
def load_blocks(typing, array, start, apart):
    """``HALF`` numbers from ``start`` on, and ``HALF`` from ``start + apart`` on, likewise."""

    def generate(context, builder, signature, values):
        array, start, apart = values
        parts = [
            builder.load(_pointer(context, builder, signature.args[0], array, at, _BLOCK), align=4)
            for at in (start, builder.add(start, apart))
        ]
        return _joined(builder, *parts)

    return _lanes(array, types.intp, types.intp), generate


@_intrinsic
def fetch(typing, array):
    """Have the C-contiguous array brought near, to be read soon."""

    def generate(context, builder, signature, values):
        whole = context.make_array(signature.args[0])(context, builder, values[0])
        start = builder.bitcast(whole.data, _BYTE.as_pointer())
        kind = ir.FunctionType(ir.VoidType(), [_BYTE.as_pointer(), _INT, _INT, _INT])
        function = get_or_insert_function(builder.module, kind, "llvm.prefetch.p0")
        length = builder.mul(whole.nitems, whole.itemsize)
        with for_range_slice(builder, length.type(0), length, length.type(_LINE)) as (at, _):
            # To be read, into the nearest cache, as data.
            builder.call(function, [builder.gep(start, [at]), _INT(0), _INT(3), _INT(1)])
        return context.get_dummy_value()

    return types.void(array), generate


@_intrinsic
def add_blocks(typing, array, start, apart, factor, value):
    """Add ``factor * value`` to what `load_blocks` reads, where its two blocks do not overlap."""

    def generate(context, builder, signature, values):
        array, start, apart, factor, value = values
        factor = _spread(builder, factor)
        for at, first in ((start, 0), (builder.add(start, apart), HALF)):
            # The halves are taken apart before they are multiplied: that one is the same for all channels.
            part = _mask(range(first, first + HALF))
            a, b = (builder.shuffle_vector(v, v, part) for v in (factor, value))
            _accumulate(builder, _pointer(context, builder, signature.args[0], array, at, _BLOCK), a, b)
        return context.get_dummy_value()

    return types.void(array, types.intp, types.intp, types.float32, _lanes), generate


def _called(builder, name, values, **more):
    """The compiler's own function ``llvm.NAME`` of lanes."""
    kind = ir.FunctionType(_VECTOR, [_VECTOR] * len(values))
    function = get_or_insert_function(builder.module, kind, f"llvm.{name}.v{LANES}f32")
    return builder.call(function, [_spread(builder, value) for value in values], **more)


@_intrinsic
def floor(typing, value):
    """The largest whole numbers up to these."""

    def generate(context, builder, signature, values):
        return _called(builder, "floor", values)

    return _lanes(_lanes), generate


@_intrinsic
def ceiling(typing, value):
    """The smallest whole numbers from these on."""

    def generate(context, builder, signature, values):
        return _called(builder, "ceil", values)

    return _lanes(_lanes), generate


def _lanes_or_number(kind: Any) -> Any:
    return kind if kind == _lanes else types.float32


@_intrinsic
def larger(typing, value, other):
    """These, or ``other``, lanes or a number, where that is larger."""

    def generate(context, builder, signature, values):
        return _called(builder, "maxnum", values)

    return _lanes(_lanes, _lanes_or_number(other)), generate


@_intrinsic
def smaller(typing, value, other):
    """These, or ``other``, lanes or a number, where that is smaller."""

    def generate(context, builder, signature, values):
        return _called(builder, "minnum", values)

    return _lanes(_lanes, _lanes_or_number(other)), generate


@_intrinsic
def inverse_root(typing, value):
    """``1 / sqrt(value)`` within 4e-7 relative, of at least 1e-20."""

    def generate(context, builder, signature, values):
        value = _called(builder, "maxnum", [*values, _FLOAT(_LEAST)])
        if not _has_avx(context):
            flags = ("afn", "arcp", "contract")
            return builder.fdiv(_all(1.0), _called(builder, "sqrt", [value], fastmath=flags), flags=flags)
        # The compiler takes a root and a quotient, which on some processors is a third of all time in the kernels.
        # An instruction takes eight.
        kind = ir.FunctionType(_EIGHT, [_EIGHT])
        estimate = get_or_insert_function(builder.module, kind, "llvm.x86.avx.rsqrt.ps.256")
        parts = (_mask(range(first, first + 8)) for first in range(0, LANES, 8))
        roots = [builder.call(estimate, [builder.shuffle_vector(value, value, part)]) for part in parts]
        root = _joined(builder, *roots) if len(roots) > 1 else roots[0]
        # A step of Newton's: from 4e-4 to 2e-7.
        half = builder.fmul(value, _all(-0.5), flags=_FLAGS)
        rest = builder.fmul(half, builder.fmul(root, root, flags=_FLAGS), flags=_FLAGS)
        return builder.fmul(root, builder.fadd(rest, _all(1.5), flags=_FLAGS), flags=_FLAGS)

    return _lanes(_lanes), generate


def _has_avx(context: Any) -> bool:
    """Whether what is compiled runs with AVX."""
    return "+avx," in f"{getattr(context.codegen(), '_tm_features', '')},"


@_intrinsic
def power_of_two(typing, value):
    """``2^value`` within 2e-7 relative where ``value`` is from -126 to 127, and any number elsewhere.

    An integer is set directly as the float's exponent, and what is left is between -1/2 and 1/2: a polynomial.
    """

    def generate(context, builder, signature, values):
        (value,) = values
        shifted = builder.fadd(value, _all(_SHIFT), flags=_FLAGS)
        rest = builder.fsub(value, builder.fsub(shifted, _all(_SHIFT), flags=_FLAGS), flags=_FLAGS)
        power = _all(_POWERS[0])
        for coefficient in _POWERS[1:]:
            power = builder.fadd(builder.fmul(power, rest, flags=_FLAGS), _all(coefficient), flags=_FLAGS)
        exponent = builder.shl(builder.bitcast(shifted, _INTS), _all(23, _INTS))
        return builder.bitcast(builder.add(builder.bitcast(power, _INTS), exponent), _VECTOR)

    return _lanes(_lanes), generate


@_intrinsic
def logarithm(typing, value):
    """``log(value)`` within 2e-7 of 1 or relative, of normal positive numbers, and any number elsewhere.

    The exponent is taken off so that f, what is left, is between 2/3 and 4/3. Of s = (f - 1) / (f + 1) an odd series is
    left.
    """

    def generate(context, builder, signature, values):
        bits = builder.bitcast(values[0], _INTS)
        above = builder.sub(bits, _all(_TWO_THIRDS, _INTS))
        exponent = builder.ashr(above, _all(23, _INTS))
        power = builder.sitofp(exponent, _VECTOR)
        rest = builder.bitcast(builder.sub(bits, builder.shl(exponent, _all(23, _INTS))), _VECTOR)
        below, beyond = (builder.fadd(rest, _all(shift), flags=_FLAGS) for shift in (-1.0, 1.0))
        s = builder.fdiv(below, beyond, flags=_FLAGS)
        square = builder.fmul(s, s, flags=_FLAGS)
        series = _all(_ODD[0])
        for coefficient in _ODD[1:]:
            series = builder.fadd(builder.fmul(series, square, flags=_FLAGS), _all(coefficient), flags=_FLAGS)
        return builder.fadd(
            builder.fmul(power, _all(math.log(2.0)), flags=_FLAGS),
            builder.fmul(series, s, flags=_FLAGS),
            flags=_FLAGS,
        )

    return _lanes(_lanes), generate


@_intrinsic
def within(typing, size, most, place, end, value):
    """``value`` in the lanes where ``size <= most`` and ``place <= end``, and 0 in the others, whatever it is there."""

    def generate(context, builder, signature, values):
        size, most, place, end, value = values
        inside, before = (
            builder.fcmp_ordered("<=", a, _spread(builder, b)) for a, b in ((size, most), (place, end))
        )
        # Two choices, one after the other, would cost the compiler's fast root.
        return builder.select(builder.and_(inside, before), value, _all(0.0))

    return _lanes(_lanes, types.float32, _lanes, types.float32, _lanes), generate


@_intrinsic
def store_folded(typing, array, start, value):
    """Write ``FOLDED`` sums of a value's lanes, of those so far apart, to ``array[start : start + FOLDED]``."""

    def generate(context, builder, signature, values):
        array, start, value = values
        while value.type.count > FOLDED:
            count = value.type.count // 2
            parts = (builder.shuffle_vector(value, value, _mask(range(k, k + count))) for k in (0, count))
            value = builder.fadd(*parts, flags=_FLAGS)
        pointer = _pointer(context, builder, signature.args[0], array, start, value.type)
        builder.store(value, pointer, align=4)
        return context.get_dummy_value()

    return types.void(array, types.intp, _lanes), generate


@_intrinsic
def lane_sums(typing, array, start):
    """Sums of ``LANES`` times what `store_folded` wrote: lane k is ``sum(array[start + k FOLDED :][:FOLDED])``.

    Two vectors at a time become one that holds sums of half as many numbers of either.
    """

    def generate(context, builder, signature, values):
        source = _pointer(context, builder, signature.args[0], *values)
        vectors = [builder.load(builder.gep(source, [_INT(k)]), align=4) for k in range(FOLDED)]
        half = FOLDED // 2
        while half:
            lower = [k for k in range(2 * LANES) if k // half % 2 == 0]
            parts = [_mask(k + shift for k in lower) for shift in (0, half)]
            vectors = [
                builder.fadd(*(builder.shuffle_vector(*pair, part) for part in parts))
                for pair in zip(vectors[::2], vectors[1::2])
            ]
            half //= 2
        return vectors[0]

    return _lanes(array, types.intp), generate

"""Checks of the Triton kernels that run on a GPU and, tiny, in Triton's interpreter on a CPU.

``python triton_cases.py NAME...`` with ``TRITON_INTERPRET=1`` runs these cases on the CPU and prints what went
wrong, as JSON.
"""

import gc
import inspect
import json
import math
import os
import sys
import traceback
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import torch
import triton_image_cases  # noqa: F401 - adds to CASES
import triton_step_cases
from triton_case import CASES

STEPS = tuple(name for name, case in CASES.items() if case.__module__ == triton_step_cases.__name__)
IMAGES = tuple(name for name in CASES if name not in STEPS)


def poison() -> None:
    """Make uninitialised tensors begin as NaN, or as a large integer, so that an unwritten element shows."""
    for name in ("empty", "empty_like"):
        setattr(torch, name, _poisoned(getattr(torch, name)))
    torch.Tensor.new_empty = _poisoned(torch.Tensor.new_empty)


def _poisoned(allocate):
    def wrapper(*args, **kwargs):
        tensor = allocate(*args, **kwargs)
        if tensor.is_floating_point():
            return tensor.fill_(float("nan"))
        return tensor.fill_(min(1 << 30, torch.iinfo(tensor.dtype).max))

    return wrapper


def patch_once() -> None:
    """Let the interpreter replace Triton's language once for each function.

    It looks for what to replace whenever one function calls another, which takes more time than the arithmetic.
    """
    from triton.runtime import interpreter

    replace, known = interpreter._patch_lang, set()

    def replace_once(function):
        if function not in known:
            replace(function)
            known.add(function)
        # Nobody in this process needs the language as it was.
        return SimpleNamespace(restore=lambda: None)

    interpreter._patch_lang = replace_once


def hurry() -> None:
    """Let the interpreter know numpy's types by name, and sort as numpy does: a third of its time.

    It makes a table of all types for every operation, and sorts by a network of hundreds of operations.
    """
    import triton.language as tl
    from triton.runtime import interpreter

    look_up, known = interpreter._get_np_dtype, {}

    def numpy_type(of):
        name = of.scalar.name
        if name not in known:
            known[name] = look_up(of)
        return known[name]

    interpreter._get_np_dtype = numpy_type
    tl.sort = lambda of: tl.tensor(interpreter.TensorHandle(np.sort(of.handle.data), of.dtype), of.type)


def know_types() -> None:
    """Let the interpreter make the type and the shape of a tensor once, and look no further where two shapes agree.

    It makes them anew for every number, which takes half of its time. No arithmetic is left out.
    """
    import triton.language as tl
    from triton.language import semantic

    if not hasattr(semantic, "TritonSemantic"):  # before Triton 3.4
        return
    made, shapes = {}, {}
    begin, broadcast = tl.block_type.__init__, semantic.TritonSemantic.broadcast_impl_value

    def sides(shape):
        if shape not in shapes:
            shapes[shape] = tl.constexpr(math.prod(shape)), tl.core.tuple([tl.constexpr(n) for n in shape])
        return shapes[shape]

    def block_type(self, element_ty, shape):
        key = (element_ty.name, *(getattr(side, "value", side) for side in shape))
        if key not in made:
            begin(self, element_ty, shape)
            made[key] = vars(self) | {"of_all": sides(tuple(self.shape))}
        vars(self).update(made[key])

    def tensor(self, handle, type):
        self.handle, self.type, self.dtype = handle, type, type.scalar
        known = vars(type).get("of_all")
        self.numel, self.shape = known or sides(tuple(type.shape) if type.is_block() else ())

    def together(self, one, other):
        alike = one.type.is_block() and other.type.is_block() and [*one.type.shape] == [*other.type.shape]
        return (one, other) if alike else broadcast(self, one, other)

    tl.block_type.__init__, tl.tensor.__init__ = block_type, tensor
    semantic.TritonSemantic.broadcast_impl_value = together


def know_numbers() -> None:
    """Let the interpreter promote no types where two agree, and make a tensor of a number once: half of its time.

    What it makes of a number is read only, so that nothing could change it for another.
    """
    import triton.language as tl
    from triton.language import semantic

    if not hasattr(semantic, "TritonSemantic"):  # before Triton 3.4
        return
    promote, made = semantic.TritonSemantic.binary_op_type_checking_impl, {}
    usual, whole, numbers = {"fp32", "fp64", "int1", "int32", "int64"}, {"int32", "int64"}, {int, float}

    def promoted(self, one, other, *rest, **named):
        kinds = type(one), type(other)
        if kinds == (tl.tensor, tl.tensor):
            name = one.dtype.name
            if name in usual and (
                one.type is other.type or (name == other.dtype.name and one.shape is other.shape)
            ):
                return one, other
            # Pointers and how far to go from them, which are not promoted.
            if (
                rest[:1] == (True,)
                and other.dtype.name in whole
                and one.dtype.is_ptr()
                and one.shape is other.shape
            ):
                return one, other
        elif tl.tensor in kinds and (kinds[0] in numbers or kinds[1] in numbers):
            first = kinds[0] is tl.tensor
            tensor, number = (one, other) if first else (other, one)
            # Minus zero is equal to zero, and one to 1.0.
            value, like = number or str(number), (tensor.dtype.name, id(tensor.shape))
            key = kinds, value, like, rest, *named.items()
            if key not in made:
                both = promote(self, one, other, *rest, **named)
                if both[not first] is not tensor:
                    return both
                made[key] = both[first]
                made[key].handle.data.setflags(write=False)
            return (one, made[key]) if first else (made[key], other)
        return promote(self, one, other, *rest, **named)

    semantic.TritonSemantic.binary_op_type_checking_impl = promoted


def work_out_at_once() -> None:
    """Let the interpreter add, subtract and multiply numbers of one type without asking of what kind they are.

    With pointers that move without promotion it takes a fifth less. The arithmetic is numpy's, as ever.
    """
    import triton.language as tl
    from triton.language import semantic
    from triton.runtime.interpreter import TensorHandle

    if not hasattr(semantic, "TritonSemantic"):  # before Triton 3.4
        return
    plain = {"fp32", "fp64", "int32", "int64"}

    def made(data, like):
        # Of one type with what it is made of: there is nothing to check.
        handle = object.__new__(TensorHandle)
        handle.data, handle.dtype, handle.attr = data, like.dtype, {}
        return tl.tensor(handle, like.type)

    def at_once(usual, operation):
        def work_out(self, one, other, sanitize_overflow):
            tensor = one if type(one) is tl.tensor else other
            checked = sanitize_overflow and self.builder.options.sanitize_overflow
            if type(tensor) is not tl.tensor or (name := tensor.dtype.name) not in plain or checked:
                return usual(self, one, other, sanitize_overflow)
            both = type(one) is type(other) is tl.tensor
            if both and name == other.dtype.name and one.shape is other.shape:
                return made(operation(one.handle.data, other.handle.data), one)
            one, other = self.binary_op_type_checking_impl(one, other, True, True)
            if one.dtype.name not in plain or one.dtype.name != other.dtype.name:
                return usual(self, one, other, sanitize_overflow)
            return made(operation(one.handle.data, other.handle.data), one)

        return work_out

    for name, operation in (("add", np.add), ("sub", np.subtract), ("mul", np.multiply)):
        usual = getattr(semantic.TritonSemantic, name)
        setattr(semantic.TritonSemantic, name, at_once(usual, operation))
    convert = semantic.TritonSemantic.cast

    def cast(self, of, kind, *rest):
        # To what it is already.
        there = not rest and type(kind) is tl.dtype and kind.name == of.dtype.name
        return of if there else convert(self, of, kind, *rest)

    semantic.TritonSemantic.cast = cast


def call_at_once() -> None:
    """Let the interpreter call functions of the language without copying names, and unwrap only what is wrapped."""
    import triton.language as tl
    from triton.runtime import interpreter

    # An older Triton patches otherwise.
    if [*inspect.signature(interpreter._patch_attr).parameters][2:] != ["member", "builder", "scope"]:
        return
    unwrap, plain = tl.core._unwrap_if_constexpr, {tl.tensor, int, float, bool, type(None)}
    operators = {
        f"__{turned}{name}__": (name, turned) for name in ("add", "sub", "mul") for turned in ("", "r")
    }

    def operator(call, name, turned):
        work_out, given = (
            getattr(type(interpreter.interpreter_semantic), name),
            interpreter.interpreter_semantic,
        )

        def operate(self, other):
            if type(other) not in plain:
                return call(self, other)
            return work_out(given, other, self, True) if turned else work_out(given, self, other, True)

        return operate

    def patch(of, name, member, builder, scope):
        # Most wrap the function itself, to check that `_semantic` is given.
        function, given = getattr(member, "__wrapped__", member), interpreter.interpreter_semantic

        def call(*args, **named):
            named["_semantic"] = given
            return function(*args, **named)

        quick = of is tl.tensor and name in operators
        scope.set_attr(of, name, operator(call, *operators[name]) if quick else call)

    interpreter._patch_attr = patch
    tl.core._unwrap_if_constexpr = lambda of: of if type(of) in plain else unwrap(of)


def skip_unread_sums() -> None:
    """Let the interpreter work out no sum of whole numbers a second time, in 64 bits: a sixth of its time.

    It compares the two only where it debugs, and here it does not: nothing is looked at less.
    """
    from triton.runtime import interpreter

    options = interpreter.interpreter_builder.options
    if not options.debug and hasattr(options, "sanitize_overflow"):
        interpreter.interpreter_builder.options = replace(options, sanitize_overflow=False)


def share_windows(parts: int) -> None:
    """Let so many programs at most share out a window."""
    from tomo_polysplat.kernels.project import triton_forward as images
    from tomo_polysplat.kernels.voxelise import triton_forward as volumes

    images._MOST_PARTS = volumes._MOST_PARTS = parts


def main() -> None:
    # Nearly all of what the interpreter makes is gone with its last name; to look for circles takes a tenth.
    gc.disable()
    poison()
    patch_once()
    hurry()
    know_types()
    know_numbers()
    work_out_at_once()
    call_at_once()
    skip_unread_sums()
    np.seterr(all="ignore")  # the interpreter computes masked lanes too
    problems = {}
    for name in sys.argv[1:]:
        # The first steps and the first images as on a GPU; else most of the 16 find nothing in so small a window.
        share_windows(16 if name in (STEPS[0], IMAGES[0]) else 2)
        try:
            CASES[name]("cpu")
        except Exception:  # of any kind: its traceback goes to the test of that case, which fails with it
            problems[name] = traceback.format_exc()
    json.dump(problems, sys.stdout)
    # Else Python looks through all that is loaded once more, to free what ends with the process.
    sys.stdout.flush()
    os._exit(0)


if __name__ == "__main__":
    main()

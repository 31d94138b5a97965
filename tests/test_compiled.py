"""The garbage collector rests while numba compiles, and only then; and all of ours is compiled so."""

import gc
import re
from pathlib import Path

import numba
import numpy as np
import pytest
from numba.extending import overload

from tomo_polysplat import compiled
from tomo_polysplat.compiled import njit

seen = []


def watched(value):
    pass


@overload(watched)
def _typed(value):
    # Runs in the compiler, amid the function that calls it.
    seen.append(gc.isenabled())
    if not isinstance(value, numba.types.Number):
        raise numba.errors.TypingError("not a number")
    return lambda value: value


def function_of(module):
    def function(value):
        return watched(value)

    function.__module__ = module
    return njit(function)


# Of another type each, as numba asks once a type.
@pytest.mark.parametrize("enabled, value", [(True, 2.0), (False, np.float32(2))])
def test_the_collector_rests_while_a_function_is_compiled(enabled, value):
    seen.clear()
    (gc.enable if enabled else gc.disable)()
    try:
        assert function_of("tomo_polysplat.some")(value) == 2.0
        assert gc.isenabled() is enabled
    finally:
        gc.enable()
    assert seen and not any(seen)


def test_it_works_on_for_functions_of_others():
    seen.clear()
    assert function_of("tomo_polysplatter")(2) == 2
    assert seen and all(seen) and gc.isenabled()


def test_it_works_on_after_a_function_that_cannot_be_compiled():
    with pytest.raises(numba.errors.TypingError):
        function_of("tomo_polysplat.some")("text")
    assert gc.isenabled()


def test_every_function_of_the_package_is_compiled_so():
    package = Path(compiled.__file__).parent
    others = [path for path in package.rglob("*.py") if path.name != "compiled.py"]
    assert len(others) > 100
    wrong = re.compile(r"^import numba$|from numba import.*jit", re.M)
    told = [path.name for path in others if wrong.search(path.read_text(encoding="utf-8"))]
    assert not told, f"import njit or called from tomo_polysplat.compiled in {told}"

"""The optimiser's steps by the Triton kernels in Triton's interpreter; a file apart, for a worker of its own."""

import pytest
from triton_cases import STEPS
from triton_interpreter import interpret


@pytest.fixture(scope="module")
def interpreted() -> dict[str, str]:
    return interpret(STEPS)


@pytest.mark.parametrize("name", STEPS)
def test_in_the_interpreter(name, interpreted):
    assert name not in interpreted, interpreted[name]

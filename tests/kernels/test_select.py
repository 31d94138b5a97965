"""The choice of an implementation is explained, checked by running it, and overruled only by name."""

import pytest
import torch

from tomo_polysplat.kernels import select

CPU = torch.device("cpu")


@pytest.fixture
def fresh_availability():
    """Availability is found once a process; these tests change what would be found."""
    select.availability.cache_clear()
    yield
    select.availability.cache_clear()


def test_cpu_runs_the_compiled_kernel_and_says_why():
    name, reason = select.choose(CPU)
    assert name == "numba"
    assert "self-check" in reason
    assert "not triton: runs on cuda only" in reason


def test_a_kernel_asked_for_by_name():
    assert select.choose(CPU, "reference") == ("reference", "asked for")


def test_unknown_kernel():
    with pytest.raises(
        ValueError, match="kernel: expected auto or one of triton, numba, reference, got 'opencl'"
    ):
        select.choose(CPU, "opencl")


def test_kernel_that_cannot_run_on_the_device():
    with pytest.raises(ValueError, match="runs on cuda only.*use kernel='auto'"):
        select.choose(CPU, "triton")


def test_a_kernel_that_is_wrong_is_not_used(monkeypatch, fresh_availability):
    monkeypatch.setattr(select, "_self_check", lambda name, device: 0.25)
    usable, reason = select.availability("numba", "cpu")
    assert not usable
    assert "differs from the reference by 2.5e-01" in reason
    name, reason = select.choose(CPU)
    assert name == "reference"
    assert "not numba: self-check differs" in reason


def test_a_self_check_that_gives_nan_is_a_failure(monkeypatch, fresh_availability):
    monkeypatch.setattr(select, "_self_check", lambda name, device: float("nan"))
    assert not select.availability("numba", "cpu")[0]


@pytest.mark.parametrize("problem", [RuntimeError("no compiler\nlong story"), AssertionError()])
def test_a_kernel_that_does_not_compile_is_not_used(monkeypatch, fresh_availability, problem):
    def broken(name, device):
        raise problem

    monkeypatch.setattr(select, "_self_check", broken)
    usable, reason = select.availability("numba", "cpu")
    assert not usable
    assert type(problem).__name__ in reason
    assert "long story" not in reason
    assert select.choose(CPU)[0] == "reference"


def test_availability_is_found_once(monkeypatch, fresh_availability):
    calls = []
    monkeypatch.setattr(select, "_self_check", lambda name, device: calls.append(name) or 0.0)
    assert select.availability("numba", "cpu") == select.availability("numba", "cpu")
    assert calls == ["numba"]


def test_description_covers_every_kernel_and_device():
    rows = {(name, device): (usable, reason) for name, device, usable, reason in select.describe()}
    assert rows["reference", "cpu"][0]
    assert rows["numba", "cpu"][0]
    assert all(reason for _, reason in rows.values())
    if not torch.cuda.is_available():
        assert rows["triton", "cuda"] == (False, "torch finds no CUDA device")


@pytest.mark.gpu
def test_cuda_runs_triton():
    assert select.choose(torch.device("cuda"))[0] == "triton"

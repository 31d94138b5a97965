"""The choice of an implementation is explained, checked by running it, and overruled only by name."""

import pytest
import torch

from tomo_polysplat.kernels import select
from tomo_polysplat.kernels.project import autograd

CPU = torch.device("cpu")


@pytest.fixture
def fresh_availability():
    """The self-check is made once a process; these tests change what would be found."""
    select._self_check.cache_clear()
    yield
    select._self_check.cache_clear()


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


def test_a_kernel_that_is_wrong_is_not_used_and_the_log_warns(monkeypatch, caplog):
    monkeypatch.setattr(select, "_self_check", lambda name, device: 0.25)
    usable, reason = select.availability("numba", "cpu")
    assert not usable
    assert "differs from the reference by 2.5e-01" in reason
    name, reason = select.choose(CPU)
    assert name == "reference"
    assert "not numba: self-check differs" in reason
    assert "far slower" in caplog.text


@pytest.fixture
def gpu_without_compiler(monkeypatch):
    """A GPU that torch finds and nothing compiles for."""

    def broken(name, device):
        raise RuntimeError("no C compiler")

    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 1)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 0)
    monkeypatch.setattr(select, "_self_check", broken)


def test_a_gpu_without_compiled_kernels_is_refused_before_the_work(gpu_without_compiler):
    with pytest.raises(RuntimeError, match="no C compiler.*use device='cpu'"):
        select.choose(torch.device("cuda"))
    assert select.choose(torch.device("cuda"), "reference") == ("reference", "asked for")


def test_auto_is_the_cpu_where_the_gpu_has_no_compiled_kernels(gpu_without_compiler, caplog):
    assert select.pick_fast_device("auto") == CPU
    assert "no C compiler" in caplog.text
    # With its index, as tensors on it have theirs.
    assert select.pick_fast_device("cuda") == torch.device("cuda", 0)


def test_a_self_check_that_gives_nan_is_a_failure(monkeypatch):
    monkeypatch.setattr(select, "_self_check", lambda name, device: float("nan"))
    assert not select.availability("numba", "cpu")[0]


@pytest.mark.parametrize("problem", [RuntimeError("no compiler\nlong story"), AssertionError()])
def test_a_kernel_that_does_not_compile_is_not_used(monkeypatch, problem):
    def broken(name, device):
        raise problem

    monkeypatch.setattr(select, "_self_check", broken)
    usable, reason = select.availability("numba", "cpu")
    assert not usable
    assert type(problem).__name__ in reason
    assert "long story" not in reason
    assert select.choose(CPU)[0] == "reference"


def test_what_runs_is_found_once_and_a_failure_is_not_remembered(monkeypatch, fresh_availability):
    calls = []

    def counted(*arguments, **options):
        calls.append(options["kernel"])
        if len(calls) == 1:
            raise MemoryError("full just now")
        return project(*arguments, **options)

    project = autograd.project
    monkeypatch.setattr(autograd, "project", counted)
    assert not select.availability("numba", "cpu")[0]
    assert select.availability("numba", "cpu")[0]
    made = len(calls)
    assert select.availability("numba", "cpu")[0]
    assert len(calls) == made


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

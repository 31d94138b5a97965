"""One run of one method: its seconds, its memory, and its error as time goes on."""

from __future__ import annotations

import gc
import sys
import time
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from tomo_polysplat.bench.methods import Method
from tomo_polysplat.bench.peers import Skipped
from tomo_polysplat.bench.task import Options, Task
from tomo_polysplat.fit.optimise import FitState
from tomo_polysplat.result.metrics import psnr
from tomo_polysplat.scan.scan import Scan

__all__ = ["Run", "error_history", "measure"]


@dataclass
class Run:
    """What came of a run.

    Attributes
    ----------
    volume : (nz, ny, nx) array, or None after a failure
    seconds : float or None
        From the projections in host memory to the volume there.
    peak_memory : int or None
        Bytes: on CUDA the most that torch held during the run, without ASTRA's own; on the CPU the most that
        the whole process ever held until then.
    about : dict
        What the method says of the run, or ``error`` after a failure, or ``skipped`` with the reason.
    cpu_seconds : float or None
        Of all threads of the process meanwhile: what the run costs however busy the machine is otherwise.
    """

    volume: np.ndarray | None
    seconds: float | None
    peak_memory: int | None
    about: dict[str, Any] = field(default_factory=dict)
    cpu_seconds: float | None = None


def measure(method: Method, task: Task, options: Options) -> Run:
    """Run a method once, unobserved; a failure is a result too, and leaves the other methods their turn."""
    cuda = task.device.startswith("cuda")
    gc.collect()
    if cuda:
        # ASTRA allocates beside torch, which would otherwise keep what it no longer uses.
        torch.cuda.empty_cache()
        torch.cuda.reset_peak_memory_stats()
    started, worked = time.perf_counter(), time.process_time()
    try:
        volume, about = method.run(task, options)
    except Skipped as reason:
        return Run(None, None, None, {"skipped": str(reason)})
    except Exception as error:
        return Run(None, None, None, {"error": f"{type(error).__name__}: {error}"})
    seconds, cpu_seconds = time.perf_counter() - started, time.process_time() - worked
    peak = torch.cuda.max_memory_allocated() if cuda else _peak_of_process()
    if not np.isfinite(volume).all():
        return Run(None, None, peak, {**about, "error": "the volume is not finite"})
    return Run(volume, seconds, peak, about, cpu_seconds)


def _peak_of_process() -> int | None:
    try:
        import resource
    except ImportError:  # Windows has none
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def error_history(
    method: Method, task: Task, settings: dict[str, Any], longest: float | None, spacing: float = 1.15
) -> list[dict[str, Any]]:
    """Errors against the truth as a run goes on, the time it takes to find them left out.

    Parameters
    ----------
    method : Method
        One that improves with time.
    task : Task
        Whose scan has a truth.
    settings : dict
        Changes of the solver's settings.
    longest : float or None
        Seconds after which the run is ended. It gets no time budget, by which it would hurry.
    spacing : float
        A point is taken when so many times the seconds of the last one have passed; 0 takes every pass.

    Returns
    -------
    list of dict
        ``seconds``, ``psnr``, ``psnr_all``, ``rmse``, see :func:`tomo_polysplat.result.metrics.compare`;
        ``iteration``, and ``loss`` and ``held_out`` of the rays (None where they are not finite).
    """
    history: list[dict[str, Any]] = []
    watching = 0.0

    def watch(state: FitState) -> bool:
        nonlocal watching
        entered = time.perf_counter()
        seconds = state.seconds - watching
        if not history or seconds > spacing * history[-1]["seconds"]:
            rays = {key: state.record()[key] for key in ("iteration", "loss", "held_out")}
            history.append({"seconds": seconds, **_errors(state.volume(), task.scan), **rays})
        watching += time.perf_counter() - entered
        return longest is not None and seconds >= longest

    method.run(task, Options(None, settings, [watch]))
    return history


def _errors(volume: np.ndarray, scan: Scan) -> dict[str, float]:
    """The figures of `compare` that cost next to nothing."""
    assert scan.truth is not None
    error = volume - scan.truth
    rest = slice(None) if scan.metal_mask is None else ~scan.metal_mask
    return {
        "psnr": psnr(error[rest], float(scan.truth[rest].max())),
        "psnr_all": psnr(error, float(scan.truth.max())),
        "rmse": float(np.sqrt(np.mean(np.square(error[rest], dtype=np.float64)))),
    }

"""All methods on one scan: warmed up, timed within budgets, compared with the truth, watched as they go."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from tomo_polysplat.bench.measure import Run, error_history, measure
from tomo_polysplat.bench.methods import Method
from tomo_polysplat.bench.scenes import fewer_views
from tomo_polysplat.bench.task import Options, Task
from tomo_polysplat.fit.stopping import BY_TIME
from tomo_polysplat.free_memory import available_memory
from tomo_polysplat.parallel import run_tasks
from tomo_polysplat.result.metrics import compare
from tomo_polysplat.scan.scan import Scan

__all__ = [
    *("Errors", "Progress", "Record", "curves", "plain_errors", "timed_runs", "warm_up", "with_errors"),
    "without_figures",
]

Record = dict[str, Any]
Progress = Callable[[str], Any]
Errors = Callable[[Any, Scan], dict[str, Any]]

# A warm-up uses few views of a scan of full size, so that all that depends on a size gets compiled; but enough for
# their halves to be compared (`start.agreement`), which loads code as well.
_WARM_UP_VIEWS, _WARM_UP_BUDGET = 90, 1.0
# A run that ended before this share of its budget, and does not tell why, would not use a larger one.
_USED_UP = 0.9
# Bytes a voxel that finding the errors of one volume takes.
_BYTES_OF_ERRORS = 160


def warm_up(
    methods: Mapping[str, Method], task: Task, settings: dict[str, Any], progress: Progress
) -> list[Record]:
    """``method``, ``cold_seconds`` and ``warm_seconds`` of the first and second run on few views of a scan."""
    few = Task.of(fewer_views(task.scan, _WARM_UP_VIEWS), task.device, task.seed)
    options = Options(_WARM_UP_BUDGET, {**settings, "passes": 1.0})
    entries = []
    for name, method in methods.items():
        progress(f"{task.scan.name}: warming up {name}")
        # A first run may take its time, compilers and all: no budget would let it reach its end.
        cold = measure(method, few, Options(None, options.settings))
        if method.whole and task.device.startswith("cuda"):
            measure(method, few, Options(None, {**options.settings, **method.whole}))
        warm = measure(method, few, options) if cold.seconds is not None else cold
        entries.append({"method": name, "cold_seconds": cold.seconds, "warm_seconds": warm.seconds})
    return entries


def timed_runs(
    methods: Mapping[str, Method],
    task: Task,
    budgets: Sequence[float],
    settings: dict[str, Any],
    progress: Progress,
) -> list[tuple[Record, Run]]:
    """Every method, once or within each budget: ``method`` and ``budget``, and what came of it."""
    runs: list[tuple[Record, Run]] = []
    for name, method in methods.items():
        for budget in sorted(budgets) if method.improves and budgets else [None]:
            within = "" if budget is None else f" within {budget:g} s"
            progress(f"{task.scan.name}: {name}{within}")
            run = measure(method, task, Options(budget, dict(settings)))
            runs.append(({"method": name, "budget": budget}, run))
            if budget is None or run.seconds is None or not _cut(run, budget):
                break
    return runs


def _cut(run: Run, budget: float) -> bool:
    """Whether the budget ended a run, which one that keeps time for its volume may be well before."""
    assert run.seconds is not None
    if "stop" in run.about:
        return run.about["stop"]["value"] in BY_TIME
    return run.seconds >= _USED_UP * budget


def plain_errors(volume: Any, scan: Scan) -> dict[str, Any]:
    """Those of :func:`~tomo_polysplat.result.metrics.compare`."""
    assert scan.truth is not None
    return compare(volume, scan.truth, scan.metal_mask)


def with_errors(
    runs: Sequence[tuple[Record, Run]], scan: Scan, errors_of: Errors = plain_errors
) -> list[Record]:
    """Records of runs, JSON-able, with the errors of their volumes: as many at a time as memory allows.

    Each has ``seconds``, ``cpu_seconds``, ``peak_memory_bytes`` and ``about``; one that failed has no seconds and
    no errors.
    """
    assert scan.truth is not None
    room = (available_memory() or 2**31) // (_BYTES_OF_ERRORS * scan.truth.size)
    together = max(1, int(min(room, len(runs))))

    def errors(run: Run) -> dict[str, Any]:
        return {} if run.volume is None else errors_of(run.volume, scan)

    tasks = [(run,) for _, run in runs]
    parts = [tasks[first : first + together] for first in range(0, len(tasks), together)]
    found = [error for part in parts for error in run_tasks(errors, part)]
    return [
        {
            **named,
            "seconds": run.seconds,
            "cpu_seconds": run.cpu_seconds,
            **error,
            "peak_memory_bytes": run.peak_memory,
            "about": run.about,
        }
        for (named, run), error in zip(runs, found, strict=True)
    ]


def without_figures(run: Mapping[str, Any]) -> str:
    """Why a record has no figures."""
    about = run["about"]
    return f"skipped: {about['skipped']}" if "skipped" in about else f"failed: {about['error']}"


def curves(
    methods: Mapping[str, Method],
    task: Task,
    settings: dict[str, Any],
    progress: Progress,
    *,
    longest: float | None = None,
    spacing: float = 1.15,
) -> list[Record]:
    """``method`` and ``history`` of errors against seconds, of the methods that improve; see `error_history`."""
    found = []
    for name, method in methods.items():
        if method.improves:
            progress(f"{task.scan.name}: {name}, error as it goes")
            try:
                history = error_history(method, task, dict(settings), longest, spacing)
            except Exception as error:
                progress(f"{name} failed: {error}")
                continue
            found.append({"method": name, "history": history})
    return found

"""Whole reconstructions against each other: scenes x sizes x methods x time budgets, on shared scans."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from tomo_polysplat.bench.environment import environment
from tomo_polysplat.bench.measure import Run, error_history, measure
from tomo_polysplat.bench.methods import METHODS, Options, Task
from tomo_polysplat.bench.scenes import cached_scan, fewer_views
from tomo_polysplat.checks import fail, require_choice
from tomo_polysplat.files import available_memory
from tomo_polysplat.parallel import run_tasks
from tomo_polysplat.result.metrics import compare
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.scenes import SCENES

__all__ = ["ReconBench", "run_recon_bench"]

# A warm-up uses few views of a scan of full size, so that all that depends on a size gets compiled.
_WARM_UP_VIEWS, _WARM_UP_BUDGET = 45, 1.0
# A run that ended by itself before this share of its budget would not use a larger one.
_USED_UP = 0.9
# Bytes a voxel that finding the errors of one volume takes.
_BYTES_OF_ERRORS = 160

Record = dict[str, Any]


@dataclass(frozen=True)
class ReconBench:
    """What to compare.

    Attributes
    ----------
    scenes, methods : sequence of str
        Names of ``simulate.SCENES`` and of ``bench.methods.METHODS``.
    sizes : sequence of int
        Voxels per edge; the detector has half as many pixels again along either side.
    views : int
    budgets : sequence of float
        Seconds for methods that improve with time; none lets them run to their own end.
    device : str
    seed : int
        Of the scans' noise and of the methods.
    photons : float
        Counts of an unattenuated ray.
    kvp : float
        Tube voltage, behind 1 mm of aluminium.
    curves : bool
        Whether errors are also followed during a run of its own of each method that improves.
    settings : dict
        Changes of the solver's settings.
    """

    scenes: Sequence[str] = ("pins", "teeth")
    sizes: Sequence[int] = (64,)
    methods: Sequence[str] = ("fdk", "fdk-water", "sirt", "voxel-poly", "mono", "polysplat")
    views: int = 180
    budgets: Sequence[float] = ()
    device: str = "cpu"
    seed: int = 0
    photons: float = 1e5
    kvp: float = 90.0
    curves: bool = True
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.scenes:
            require_choice("scenes", name, SCENES)
        for name in self.methods:
            require_choice("methods", name, METHODS)
        if min(self.budgets, default=1.0) <= 0:
            raise fail("budgets", "seconds above 0", str(list(self.budgets)))
        if self.device.startswith("cuda") and not torch.cuda.is_available():
            raise fail("device", "a device that is there", repr(self.device), "torch finds no CUDA device")

    def scan(self, scene: str, size: int, folder: Path | None) -> Scan:
        """One of its scans."""
        physics = {"photons": self.photons, "kvp": self.kvp, "filters": {"Al": 0.1}, "seed": self.seed}
        return cached_scan(scene, size, self.views, folder=folder, **physics)


def run_recon_bench(
    bench: ReconBench,
    *,
    cache: Path | None = None,
    progress: Callable[[str], Any] = lambda _: None,
    update: Callable[[Record], Any] = lambda _: None,
) -> Record:
    """Run it.

    Parameters
    ----------
    bench : ReconBench
    cache : path, optional
        Folder of simulated scans; None for a temporary one of this user.
    progress : callable
        Told in words what comes next.
    update : callable
        Given the record after every scan, so that an interrupted benchmark leaves something.

    Returns
    -------
    dict
        JSON-able: ``bench``, ``environment``, ``warm_up`` (``size``, ``method``, ``cold_seconds`` and
        ``warm_seconds`` of the first and second run on few views) and ``runs`` (``scene``, ``size``, ``method``,
        ``budget``, ``seconds``, the errors of :func:`~tomo_polysplat.result.metrics.compare`,
        ``peak_memory_bytes``, ``about``), and ``curves`` (``scene``, ``size``, ``method``, ``history``).
        A run that failed has no seconds and no errors, and ``about`` says why.
    """
    record: Record = {
        "bench": asdict(bench),
        "environment": environment(),
        "warm_up": [],
        "runs": [],
        "curves": [],
    }
    for size in bench.sizes:
        for scene in bench.scenes:
            progress(f"{scene} {size}: scan")
            started = time.perf_counter()
            scan = bench.scan(scene, size, cache)
            progress(f"{scene} {size}: scan took {time.perf_counter() - started:.1f} s, not counted")
            if scene == bench.scenes[0]:
                record["warm_up"] += _warm_up(bench, scan, size, progress)
            task = Task.of(scan, bench.device, bench.seed)
            record["runs"] += _runs(bench, task, size, progress)
            record["curves"] += _curves(bench, task, size, progress)
            update(record)
    return record


def _warm_up(bench: ReconBench, scan: Scan, size: int, progress: Callable[[str], Any]) -> list[Record]:
    """The first and the second run of every method at this size."""
    task = Task.of(fewer_views(scan, _WARM_UP_VIEWS), bench.device, bench.seed)
    options = Options(_WARM_UP_BUDGET, {**bench.settings, "passes": 1.0})
    entries = []
    for name in bench.methods:
        progress(f"{scan.name} {size}: warming up {name}")
        # A first run may take its time, compilers and all: no budget would let it reach its end.
        cold = measure(METHODS[name], task, Options(None, options.settings))
        warm = measure(METHODS[name], task, options)
        entries.append(
            {"size": size, "method": name, "cold_seconds": cold.seconds, "warm_seconds": warm.seconds}
        )
    return entries


def _runs(bench: ReconBench, task: Task, size: int, progress: Callable[[str], Any]) -> list[Record]:
    """The timed runs on one scan, with their errors, which are found when all clocks have stopped."""
    runs: list[tuple[Record, Run]] = []
    for name in bench.methods:
        improves = METHODS[name].improves
        for budget in sorted(bench.budgets) if improves and bench.budgets else [None]:
            within = "" if budget is None else f" within {budget:g} s"
            progress(f"{task.scan.name} {size}: {name}{within}")
            run = measure(METHODS[name], task, Options(budget, dict(bench.settings)))
            about = {"scene": task.scan.name, "size": size, "method": name, "budget": budget}
            runs.append((about, run))
            if budget is None or run.seconds is None or run.seconds < _USED_UP * budget:
                break
    progress(f"{task.scan.name} {size}: errors")
    errors = _all_errors([run for _, run in runs], task.scan)
    return [
        {**about, "seconds": run.seconds, **error, "peak_memory_bytes": run.peak_memory, "about": run.about}
        for (about, run), error in zip(runs, errors, strict=True)
    ]


def _all_errors(runs: list[Run], scan: Scan) -> list[dict[str, float]]:
    """Errors of the volumes, as many at a time as memory allows."""
    assert scan.truth is not None
    room = (available_memory() or 2**31) // (_BYTES_OF_ERRORS * scan.truth.size)
    together = max(1, int(min(room, len(runs))))
    tasks = [(run, scan) for run in runs]
    parts = [tasks[first : first + together] for first in range(0, len(tasks), together)]
    return [error for part in parts for error in run_tasks(_errors_of, part)]


def _errors_of(run: Run, scan: Scan) -> dict[str, float]:
    assert scan.truth is not None
    return {} if run.volume is None else compare(run.volume, scan.truth, scan.metal_mask)


def _curves(bench: ReconBench, task: Task, size: int, progress: Callable[[str], Any]) -> list[Record]:
    """Error against seconds of the methods that improve."""
    curves = []
    for name in bench.methods if bench.curves else ():
        if METHODS[name].improves:
            progress(f"{task.scan.name} {size}: {name}, error as it goes")
            try:
                longest = max(bench.budgets, default=None)
                history = error_history(METHODS[name], task, dict(bench.settings), longest)
            except Exception as error:
                progress(f"{name} failed: {error}")
                continue
            curves.append({"scene": task.scan.name, "size": size, "method": name, "history": history})
    return curves

"""Whole reconstructions against each other: scenes x sizes x methods x time budgets, on shared scans."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch

from tomo_polysplat.bench.environment import environment
from tomo_polysplat.bench.methods import METHODS
from tomo_polysplat.bench.runs import Record, curves, timed_runs, warm_up, with_errors
from tomo_polysplat.bench.scenes import cached_scan, require_scene
from tomo_polysplat.bench.task import Task
from tomo_polysplat.checks import fail, require_choice
from tomo_polysplat.scan.scan import Scan

__all__ = ["ReconBench", "run_recon_bench"]


@dataclass(frozen=True)
class ReconBench:
    """What to compare.

    Attributes
    ----------
    scenes, methods : sequence of str
        Names for `bench.scenes.require_scene` and of ``bench.methods.METHODS``.
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
            require_scene(name)
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

    def task(self, scene: str, size: int, folder: Path | None, progress: Callable[[str], Any]) -> Task:
        """The task that one of its scans sets."""
        progress(f"{scene} {size}: scan")
        started = time.perf_counter()
        scan = self.scan(scene, size, folder)
        progress(f"{scene} {size}: scan took {time.perf_counter() - started:.1f} s, not counted")
        return Task.of(scan, self.device, self.seed)


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
        ``budget``, ``seconds``, ``cpu_seconds``, the errors of :func:`~tomo_polysplat.result.metrics.compare`,
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
    methods = {name: METHODS[name] for name in bench.methods}
    for size in bench.sizes:
        for scene in bench.scenes:
            where = {"scene": scene, "size": size}
            task = bench.task(scene, size, cache, progress)
            if scene == bench.scenes[0]:
                warmed = warm_up(methods, task, bench.settings, progress)
                record["warm_up"] += [{"size": size, **entry} for entry in warmed]
            runs = timed_runs(methods, task, bench.budgets, bench.settings, progress)
            progress(f"{scene} {size}: errors")
            record["runs"] += [{**where, **run} for run in with_errors(runs, task.scan)]
            if bench.curves:
                longest = max(bench.budgets, default=None)
                found = curves(methods, task, bench.settings, progress, longest=longest)
                record["curves"] += [{**where, **curve} for curve in found]
            update(record)
    return record

"""How accurate reconstructions are: scenes x sizes x views x tube voltages x photons, seeds repeated."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.bench.accuracy_measures import Regions, accuracy_errors
from tomo_polysplat.bench.accuracy_stopping import stopping
from tomo_polysplat.bench.environment import environment
from tomo_polysplat.bench.methods import METHODS
from tomo_polysplat.bench.recon import ReconBench
from tomo_polysplat.bench.runs import Progress, Record, curves, timed_runs, warm_up, with_errors
from tomo_polysplat.bench.task import Task
from tomo_polysplat.checks import fail
from tomo_polysplat.scan.scan import Scan

__all__ = ["CONDITION", "AccuracyBench", "Volumes", "run_accuracy_bench"]

# What tells the scans of a record apart, but for their seeds.
CONDITION = ("scene", "size", "views", "kvp", "photons")

Volumes = list[tuple[str, np.ndarray]]


@dataclass(frozen=True)
class AccuracyBench:
    """What to measure: every combination of ``scenes``, ``sizes``, ``views``, ``kvp`` and ``photons``.

    Attributes
    ----------
    scenes, methods : sequence of str
        Names for `bench.scenes.require_scene` and of ``bench.methods.METHODS``.
    sizes, views : sequence of int
    kvp, photons : sequence of float
        Tube voltages behind 1 mm of aluminium, and counts of an unattenuated ray.
    seeds : int
        Each combination is repeated with the seeds 0, 1, ..., of the scans' noise and of the methods.
    budgets : sequence of float
        Seconds for methods that improve with time; none lets them run to their own end.
    device : str
    curves : bool
        Whether the first seed is also followed pass by pass, without a stopping rule, by the methods that
        improve.
    settings : dict
        Changes of the solver's settings.
    """

    scenes: Sequence[str] = ("pins", "teeth")
    sizes: Sequence[int] = (64,)
    methods: Sequence[str] = ("fdk", "fdk-water", "sirt", "limar", "nmar", "voxel-poly", "mono", "polysplat")
    views: Sequence[int] = (180,)
    kvp: Sequence[float] = (90.0,)
    photons: Sequence[float] = (1e5,)
    seeds: int = 1
    budgets: Sequence[float] = ()
    device: str = "cpu"
    curves: bool = True
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise fail("seeds", "at least 1", str(self.seeds))
        for _ in self.scans():  # each checks its names and numbers
            pass

    def scans(self) -> Iterator[ReconBench]:
        """Its scans one by one, sizes outermost and seeds innermost."""
        combined = itertools.product(self.sizes, self.scenes, self.views, self.kvp, self.photons)
        for size, scene, views, kvp, photons in combined:
            for seed in range(self.seeds):
                yield ReconBench(
                    scenes=(scene,),
                    sizes=(size,),
                    methods=self.methods,
                    views=views,
                    budgets=self.budgets,
                    device=self.device,
                    seed=seed,
                    photons=photons,
                    kvp=kvp,
                    settings=self.settings,
                )


def run_accuracy_bench(
    bench: AccuracyBench,
    *,
    cache: Path | None = None,
    progress: Progress = lambda _: None,
    update: Callable[[Record, Record, Scan, Volumes], Any] = lambda *_: None,
) -> Record:
    """Run it.

    Parameters
    ----------
    bench : AccuracyBench
    cache : path, optional
        Folder of simulated scans; None for a temporary one of this user.
    progress : callable
        Told in words what comes next.
    update : callable
        Given the record so far, the condition (a dict), the scan and its volumes with their labels after every
        scan, so that an interrupted benchmark leaves what it has.

    Returns
    -------
    dict
        JSON-able: ``bench``, ``environment``, ``warm_up``, and with ``scene``, ``size``, ``views``, ``kvp``,
        ``photons`` and ``seed`` each: ``runs`` (``method``, ``budget``, ``seconds``, ``cpu_seconds``, the errors
        of `accuracy_errors`, ``peak_memory_bytes``, ``about``), ``curves`` (``method``, ``history``) and
        ``stopping`` (``method`` and what `accuracy_stopping.stopping` finds).
    """
    record: Record = {"bench": asdict(bench), "environment": environment()}
    record |= {"warm_up": [], "runs": [], "curves": [], "stopping": []}
    methods = {name: METHODS[name] for name in bench.methods}
    warmed: set[int] = set()
    for one in bench.scans():
        (scene,), (size,) = one.scenes, one.sizes
        where = {"scene": scene, "size": size, "views": one.views, "kvp": one.kvp, "photons": one.photons}
        where["seed"] = one.seed
        task = one.task(scene, size, cache, progress)
        if size not in warmed:
            warmed.add(size)
            entries = warm_up(methods, task, bench.settings, progress)
            record["warm_up"] += [{"size": size, **entry} for entry in entries]
        runs = timed_runs(methods, task, bench.budgets, bench.settings, progress)
        record["runs"] += [{**where, **run} for run in with_errors(runs, task.scan, _errors(task.scan))]
        if bench.curves and one.seed == 0:
            _watch(record, where, task, bench, progress)
        volumes = [(_label(named), run.volume) for named, run in runs if run.volume is not None]
        update(record, where, task.scan, volumes)
    return record


def _errors(scan: Scan) -> Callable[[np.ndarray, Scan], dict[str, Any]]:
    assert scan.truth is not None
    regions = Regions.of(scan.truth, scan.metal_mask)
    return lambda volume, scan: accuracy_errors(regions, volume, scan)


def _label(named: Record) -> str:
    return METHODS[named["method"]].label + ("" if named["budget"] is None else f", {named['budget']:g} s")


def _watch(record: Record, where: Record, task: Task, bench: AccuracyBench, progress: Progress) -> None:
    """Runs followed pass by pass to the end of their passes, and what their stopping rule would have kept."""
    methods = {name: METHODS[name] for name in bench.methods}
    longest = max(bench.budgets, default=None)
    endless = {**bench.settings, "patience": 1_000_000}
    for curve in curves(methods, task, endless, progress, longest=longest, spacing=0.0):
        record["curves"].append({**where, **curve})
        kept = stopping(curve["history"], bench.settings)
        if kept is not None:
            record["stopping"].append({**where, "method": curve["method"], **kept})

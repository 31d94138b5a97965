"""What a reconstruction costs and gives by its size: structures with detail everywhere, rivals beside it."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import torch

from tomo_polysplat.bench.environment import environment
from tomo_polysplat.bench.methods import METHODS
from tomo_polysplat.bench.runs import Progress, Record, plain_errors, timed_runs, warm_up, with_errors
from tomo_polysplat.bench.task import Task
from tomo_polysplat.checks import fail, require_choice
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.structures import STRUCTURES
from tomo_polysplat.simulate.voxel_scan import scan_structure

__all__ = ["CONDITION", "ScaleBench", "run_scale_bench", "structure_errors"]

# What tells the scans of a record apart, but for their seeds.
CONDITION = ("kind", "size", "metal")
# Voxels from metal within which Dice counts as near it, and beyond which contrast is taken.
_NEAR = 8
# A voxel is all of one phase within this share of the difference of both.
_PURE = 0.02


@dataclass(frozen=True)
class ScaleBench:
    """What to measure: every combination of ``kinds``, ``sizes``, ``metal`` and seeds 0, 1, ...

    Attributes
    ----------
    kinds : sequence of str
        Of ``simulate.structures.STRUCTURES``.
    sizes : sequence of int
        Voxels along an edge.
    metal : sequence of bool
        With a screw, without, or both.
    methods : sequence of str
        Of ``bench.methods.METHODS``.
    seeds : int
    views, columns : int or None
        Of every size; None: 1.5 times the voxels along an edge.
    feature : float
        Width of the detail in voxels.
    photons : float
        Counts of a free ray.
    device : str
    settings : dict
        Changes of the solver's settings.
    """

    kinds: Sequence[str] = tuple(STRUCTURES)
    sizes: Sequence[int] = (96,)
    metal: Sequence[bool] = (True,)
    methods: Sequence[str] = ("fdk", "fdk-water", "voxel-poly", "polysplat")
    seeds: int = 1
    views: int | None = None
    columns: int | None = None
    feature: float = 6.0
    photons: float = 5e4
    device: str = "cpu"
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.kinds:
            require_choice("kinds", name, STRUCTURES)
        for name in self.methods:
            require_choice("methods", name, METHODS)
        if self.seeds < 1 or min(self.sizes, default=0) < 8:
            raise fail("seeds, sizes", "at least 1, and 8 each", f"{self.seeds}, {list(self.sizes)}")
        if self.device.startswith("cuda") and not torch.cuda.is_available():
            raise fail("device", "a device that is there", repr(self.device), "torch finds no CUDA device")

    def conditions(self) -> Iterator[Record]:
        """``kind``, ``size``, ``metal`` and ``seed`` of every scan, sizes outermost."""
        for size, kind, metal in itertools.product(self.sizes, self.kinds, self.metal):
            for seed in range(self.seeds):
                yield {"kind": kind, "size": size, "metal": metal, "seed": seed}

    def scan(self, where: Record) -> Scan:
        """One of its scans."""
        return scan_structure(
            where["kind"],
            where["size"],
            self.views,
            columns=self.columns,
            feature=self.feature,
            metal=where["metal"],
            photons=self.photons,
            seed=where["seed"],
            device=self.device,
        )


def run_scale_bench(
    bench: ScaleBench,
    *,
    progress: Progress = lambda _: None,
    update: Callable[[Record], Any] = lambda _: None,
) -> Record:
    """Run it.

    Parameters
    ----------
    bench : ScaleBench
    progress : callable
        Told in words what comes next.
    update : callable
        Given the record after every scan, so that an interrupted benchmark leaves something.

    Returns
    -------
    dict
        JSON-able: ``bench``, ``environment``, ``warm_up``, and ``runs``: ``kind``, ``size``, ``metal``, ``seed``,
        ``method``, ``seconds``, ``cpu_seconds``, ``peak_memory_bytes``, the errors of `structure_errors`, ``about``.
    """
    record: Record = {"bench": asdict(bench), "environment": environment(), "warm_up": [], "runs": []}
    methods = {name: METHODS[name] for name in bench.methods}
    warmed: set[int] = set()
    for where in bench.conditions():
        started = time.perf_counter()
        scan = bench.scan(where)
        progress(f"{scan.name}: scan took {time.perf_counter() - started:.1f} s, not counted")
        task = Task.of(scan, bench.device, where["seed"])
        if where["size"] not in warmed:
            warmed.add(where["size"])
            entries = warm_up(methods, task, bench.settings, progress)
            record["warm_up"] += [{"size": where["size"], **entry} for entry in entries]
        runs = timed_runs(methods, task, (), bench.settings, progress)
        errors = _errors_of(where["kind"], scan)
        record["runs"] += [{**where, **run} for run in with_errors(runs, scan, errors)]
        update(record)
    return record


def structure_errors(volume: np.ndarray, scan: Scan, phases: tuple[float, float]) -> dict[str, Any]:
    """Errors of a volume (z, y, x) of a structure whose matrix and solid have these attenuations.

    Returns
    -------
    dict
        Those of :func:`~tomo_polysplat.result.metrics.compare`; ``dice`` of the solid, told by a threshold half way,
        in all voxels without metal, and ``dice_near_metal`` within 8 voxels of it; ``contrast`` of solid against
        matrix over the true one, 8 voxels and more from metal, and ``noise`` of the matrix there over that contrast.
        None where there are no such voxels.
    """
    from scipy.ndimage import distance_transform_edt

    assert scan.truth is not None
    truth, (matrix, solid) = scan.truth, phases
    metal = np.zeros(truth.shape, bool) if scan.metal_mask is None else scan.metal_mask
    away = distance_transform_edt(~metal) if metal.any() else np.full(truth.shape, np.inf)
    middle, difference = 0.5 * (matrix + solid), solid - matrix
    inside, there = volume > middle, truth > middle
    far = away >= _NEAR
    dense = np.abs(truth - solid) < _PURE * difference
    light = np.abs(truth - matrix) < _PURE * difference
    if matrix == 0:
        # What is empty inside of the object, not around it.
        light &= _within(there)
    dense, light = volume[dense & far], volume[light & far]
    known = len(dense) and len(light)
    contrast = float(dense.mean(dtype=float) - light.mean(dtype=float)) / difference if known else None
    return {
        **plain_errors(volume, scan),
        "dice": _dice(inside, there, ~metal),
        "dice_near_metal": _dice(inside, there, ~metal & (away <= _NEAR)) if metal.any() else None,
        "contrast": contrast,
        "noise": float(light.std(dtype=float)) / difference if known else None,
    }


def _errors_of(kind: str, scan: Scan) -> Callable[[Any, Scan], dict[str, Any]]:
    matrix, solid, _ = (
        float(mass_attenuation(one.material, scan.truth_energy_kev)) * one.density
        for one in STRUCTURES[kind].substances
    )
    return lambda volume, of: structure_errors(volume, of, (matrix, solid))


def _within(solid: np.ndarray) -> np.ndarray:
    """Voxels with solid on both sides along every axis."""
    found = np.ones(solid.shape, bool)
    for axis in range(solid.ndim):
        forth = np.logical_or.accumulate(solid, axis=axis)
        back = np.flip(np.logical_or.accumulate(np.flip(solid, axis), axis=axis), axis)
        found &= forth & back
    return found


def _dice(one: np.ndarray, other: np.ndarray, where: np.ndarray) -> float | None:
    both = int(one[where].sum()) + int(other[where].sum())
    return 2 * int((one & other)[where].sum()) / both if both else None

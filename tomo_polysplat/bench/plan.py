"""What the plan's decisions save: seconds and decibels with each and without it, and when a run should stop."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from tomo_polysplat.bench.ablation_variants import DEFAULT, Variant
from tomo_polysplat.bench.accuracy_stopping import stopping
from tomo_polysplat.bench.environment import environment
from tomo_polysplat.bench.measure import error_history
from tomo_polysplat.bench.runs import Progress, Record, timed_runs, warm_up, with_errors
from tomo_polysplat.bench.task import Task
from tomo_polysplat.checks import fail
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.orbit import circular_orbit
from tomo_polysplat.simulate.scanner import Scanner
from tomo_polysplat.simulate.scenes import SCENES, scan_phantom, scene_phantom

__all__ = ["SCANS", "PlanBench", "run_plan_bench", "variants"]

# More nodes than any spectrum here has energies, and farther than any volume is wide, in voxels.
_EVERY_ENERGY, _EVERYWHERE = 1000, 1e5
# No run is ended by the held-out rays.
_PATIENT = {"patience": 10_000}
# A variant so many decibels ahead of the plan, without metal, is compared to it on scans of other noise: the best of
# twenty runs of equal merit is ahead by luck.
_AHEAD = 0.2


@dataclass(frozen=True)
class PlanScan:
    """A scan that needs more or less of a model.

    Attributes
    ----------
    scene : str
        Of ``simulate.scenes.SCENES``.
    metal : bool
    room : float
        Edge of the volume, and width of the detector's view, over those that the scene has by itself.
    lines : tuple of float
        Energies in keV with even weights; none for a tube of 90 kV behind 1 mm of aluminium.
    """

    scene: str
    metal: bool
    room: float = 1.0
    lines: tuple[float, ...] = ()

    def scan(self, size: int, views: int, seed: int) -> Scan:
        """It, simulated with ``size`` voxels an edge of the scene, so more where there is more room."""
        count = round(size * self.room)
        pixels = -(-3 * count // 2)
        angles = 2 * np.pi * np.arange(views) / views
        half = self.room * SCENES[self.scene].half_width
        if self.lines:
            spectrum = Spectrum(np.array(self.lines), np.full(len(self.lines), 1 / len(self.lines)))
        else:
            spectrum = Spectrum.from_tube(90, filters={"Al": 0.1}, detector="counting")
        phantom = scene_phantom(self.scene, self.metal)
        geometries = circular_orbit("cone", half, count, pixels, pixels, angles)
        return scan_phantom(phantom, *geometries, spectrum, Scanner(1e5, 3.0, 0.0, True, seed))


SCANS = {
    "no metal": PlanScan("pepper", metal=False),
    "small object": PlanScan("broccoli", metal=False, room=2.0),
    "narrow spectrum": PlanScan("pepper", metal=False, lines=(54.0, 54.5, 55.0, 55.5, 56.0)),
    "metal": PlanScan("pins", metal=True),
}


@dataclass(frozen=True)
class PlanBench:
    """What to measure.

    Attributes
    ----------
    scans : sequence of str
        Of `SCANS`.
    size, views : int
        Voxels along the scene, and projection images.
    device : str
    seed : int
    again : int
        Scans of other noise on which variants that are ahead of the plan are compared to it again.
    settings : dict
        Changes of the solver's settings that all runs share.
    """

    scans: tuple[str, ...] = tuple(SCANS)
    size: int = 36
    views: int = 72
    device: str = "cpu"
    seed: int = 0
    again: int = 4
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.scans:
            if name not in SCANS:
                raise fail("scans", f"names among {', '.join(SCANS)}", repr(name))
        if min(self.size, self.views) < 1:
            raise fail("size, views", "at least 1", f"{self.size}, {self.views}")
        if self.again < 0:
            raise fail("again", "at least 0", str(self.again))


def variants(scan: PlanScan, views_per_step: int) -> list[Variant]:
    """Each decision of the plan taken otherwise, and all of those about the model left out.

    These last make as many steps as the plan, which would give a larger cloud fewer: ``views_per_step`` is its own.
    """
    # Where nothing is dense, numbers are free only if matter of any density counts as dense.
    free = {"curves": 3, "free_radius": _EVERYWHERE}
    free |= {} if scan.metal else {"bone_level": 0.1, "bone_u": 0.0}
    every = {"spectral_nodes": _EVERY_ENERGY}
    empty = {"support_level": 0.0}
    # A blur is held rather than fitted: without metal nothing would hold it.
    blur = {"learning_rate_blur": 0.0} | ({"blur": 0.0} if scan.metal else {})
    whole = {**free, **every, **empty, **({} if scan.metal else blur)}
    whole["views_per_step"] = views_per_step
    curves = 1 if scan.metal else 3
    return [
        Variant("no spectrum", one_energy=True),
        Variant(f"{curves} curve{'s' if curves > 1 else ''}", {"curves": curves}),
        Variant("every energy a node", every),
        Variant("u free everywhere", free),
        Variant("empty space seeded", empty),
        Variant("no blur" if scan.metal else "a blur", blur),
        Variant("edges taken for blurred", {"edges": "blurred"}),
        Variant("edges taken for sharp", {"edges": "sharp"}),
        Variant("no more Gaussians than seeds", {"growth": 1.0}),
        Variant("four times as many as seeds", {"growth": 4.0}),
        Variant("usual smoothing, not asked", {"tv_factor": 1.0}),
        Variant("smoothed at every step", {"tv_every": 1}),
        Variant("thin rays, not asked", {"pixel_rays": 1}),
        Variant("light averaged over pixels", {"pixel_rays": 2}),
        Variant("1 view a step", {"views_per_step": 1}),
        Variant("8 views a step", {"views_per_step": 8}),
        Variant("seeds 1 voxel apart", {"seed_spacing": 1.0}),
        Variant("seeds 1.7 voxels apart", {"seed_spacing": 1.7}),
        Variant("5 passes", {"passes": 5.0}),
        Variant("20 passes", {"passes": 20.0}),
        Variant("everything modelled", whole),
        Variant("everything, and seeds 1 voxel apart", {**whole, "seed_spacing": 1.0}),
    ]


def run_plan_bench(
    bench: PlanBench,
    *,
    progress: Progress = lambda _: None,
    update: Callable[[Record], Any] = lambda _: None,
) -> Record:
    """Run it.

    Parameters
    ----------
    bench : PlanBench
    progress : callable
        Told in words what comes next.
    update : callable
        Given the record after every run.

    Returns
    -------
    dict
        JSON-able: ``bench``, ``environment``, ``runs`` (``scan``, ``method`` for the variant, seconds, errors, and
        ``about`` with parts of the plan), ``again`` (such runs, of the plan and of the variants ahead of it, with the
        ``seed`` of the noise) and ``stopping`` (``scan``, ``history`` of every pass of a run that
        nothing ended, and ``rule``, see `bench.accuracy_stopping.stopping`).
    """
    record: Record = {"bench": asdict(bench), "environment": environment()}
    record |= {"runs": [], "again": [], "stopping": []}
    for name in bench.scans:
        progress(f"simulating: {name}")
        task = _task(name, bench, bench.seed)
        warm_up({"plan": DEFAULT.method()}, task, bench.settings, progress)
        planned = _run(DEFAULT, task, bench.settings, progress)
        record["runs"].append(planned)
        update(record)
        if planned["seconds"] is None:
            continue
        together = planned["about"]["plan"]["views_per_step"]["value"]
        ahead = []
        for variant in variants(SCANS[name], together):
            run = _run(variant, task, bench.settings, progress)
            record["runs"].append(run)
            update(record)
            if run["seconds"] is not None and run["psnr"] > planned["psnr"] + _AHEAD:
                ahead.append(variant)
        for further in range(bench.again if ahead else 0):
            other = _task(name, bench, bench.seed + 1 + further)
            for variant in (DEFAULT, *ahead):
                record["again"].append({"seed": other.seed, **_run(variant, other, bench.settings, progress)})
                update(record)
        record["stopping"].append(_stopping(task, bench.settings, progress))
        update(record)
    return record


def _task(name: str, bench: PlanBench, seed: int) -> Task:
    scan = SCANS[name].scan(bench.size, bench.views, seed)
    scan.name = name
    return Task.of(scan, bench.device, seed)


def _run(variant: Variant, task: Task, settings: Mapping[str, Any], progress: Progress) -> Record:
    runs = timed_runs({variant.label: variant.method()}, task, (), dict(settings), progress)
    return {"scan": task.scan.name, **with_errors(runs, task.scan)[0]}


def _stopping(task: Task, settings: Mapping[str, Any], progress: Progress) -> Record:
    progress(f"{task.scan.name}: error pass by pass")
    history = error_history(DEFAULT.method(), task, {**settings, **_PATIENT}, None, 0.0)
    return {"scan": task.scan.name, "history": history, "rule": stopping(history, settings)}

"""What each part of the solver is worth: seconds and decibels with the part changed or left out."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tomo_polysplat.bench.ablation_affine import affine_errors
from tomo_polysplat.bench.ablation_variants import DEFAULT, GROUPS, Variant
from tomo_polysplat.bench.accuracy_measures import Regions, accuracy_errors
from tomo_polysplat.bench.environment import environment
from tomo_polysplat.bench.recon import ReconBench
from tomo_polysplat.bench.recon_report import machine
from tomo_polysplat.bench.runs import Progress, Record, timed_runs, warm_up, with_errors, without_figures
from tomo_polysplat.bench.tables import Column, cell, grouped, markdown_table, text_table
from tomo_polysplat.bench.task import Task
from tomo_polysplat.checks import fail, require_choice

__all__ = ["AblationBench", "as_markdown", "as_text", "run_ablation"]

AFFINE = "affine"

_COLUMNS: tuple[Column, ...] = (
    ("psnr", "PSNR", "{:.1f}"),
    ("psnr_all", "PSNR all", "{:.1f}"),
    ("ssim_all", "SSIM all", "{:.4f}"),
    ("soft_bias", "soft %", "{:+.1f}"),
    ("metal_mass", "mass %", "{:+.1f}"),
    ("seconds", "seconds", "{:.1f}"),
    ("cpu_seconds", "CPU s", "{:.1f}"),
)


@dataclass(frozen=True)
class AblationBench:
    """What to measure.

    Attributes
    ----------
    scenes : sequence of str
    size, views : int
    groups : sequence of str
        Of ``ablation_variants.GROUPS``, and "affine" for the line integral.
    photons, kvp : float
    seeds : int
        Each variant is repeated with the seeds 0, 1, ..., of the scans' noise and of the solver.
    device : str
    settings : dict
        Changes of the solver's settings, which all variants share.
    """

    scenes: Sequence[str] = ("pins", "teeth")
    size: int = 64
    views: int = 180
    groups: Sequence[str] = (*GROUPS, AFFINE)
    photons: float = 1e5
    kvp: float = 90.0
    seeds: int = 1
    device: str = "cpu"
    settings: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for name in self.groups:
            require_choice("groups", name, (*GROUPS, AFFINE))
        if self.seeds < 1:
            raise fail("seeds", "at least 1", str(self.seeds))
        for _ in self.scans():  # each checks its names and numbers
            pass

    def scans(self) -> Iterator[ReconBench]:
        """Its scans one by one, seeds innermost."""
        for scene in self.scenes:
            for seed in range(self.seeds):
                yield ReconBench(
                    scenes=(scene,),
                    sizes=(self.size,),
                    methods=(),
                    views=self.views,
                    device=self.device,
                    seed=seed,
                    photons=self.photons,
                    kvp=self.kvp,
                )

    def variants(self) -> list[Variant]:
        """The default and those of the groups, each once."""
        chosen = [variant for name in self.groups if name != AFFINE for variant in GROUPS[name]]
        return [DEFAULT, *chosen] if chosen else []


def run_ablation(
    bench: AblationBench,
    *,
    cache: Path | None = None,
    progress: Progress = lambda _: None,
    update: Callable[[Record], Any] = lambda _: None,
) -> Record:
    """Run it.

    Parameters
    ----------
    bench : AblationBench
    cache : path, optional
        Folder of simulated scans; None for a temporary one of this user.
    progress : callable
        Told in words what comes next.
    update : callable
        Given the record after every run, so that an interrupted benchmark leaves what it has.

    Returns
    -------
    dict
        JSON-able: ``bench``, ``environment``, ``runs`` (``scene``, ``seed``, ``method`` for the label of the
        variant, and the figures of the accuracy benchmark) and ``affine`` (see `affine_errors`).
    """
    record: Record = {"bench": asdict(bench), "environment": environment(), "runs": [], "affine": []}
    if AFFINE in bench.groups:
        progress("the line integral and its affine approximation")
        record["affine"] = affine_errors()
        update(record)
    variants = bench.variants()
    for one in bench.scans() if variants else ():
        task = one.task(one.scenes[0], bench.size, cache, progress)
        if not record["runs"]:
            warm_up({"default": DEFAULT.method()}, task, bench.settings, progress)
        for variant in variants:
            record["runs"] += _run(variant, task, bench, progress)
            update(record)
    return record


def _run(variant: Variant, task: Task, bench: AblationBench, progress: Progress) -> list[Record]:
    """The run of one variant on one scan."""
    scan = task.scan
    assert scan.truth is not None
    regions = Regions.of(scan.truth, scan.metal_mask)
    runs = timed_runs({variant.label: variant.method()}, task, (), bench.settings, progress)
    found = with_errors(runs, scan, lambda volume, scan: accuracy_errors(regions, volume, scan))
    return [{"scene": scan.name, "seed": task.seed, **run} for run in found]


def as_text(record: Mapping[str, Any]) -> str:
    """For a terminal."""
    return "\n\n".join(f"{head}\n{text_table(*table)}" for head, table in _tables(record))


def as_markdown(record: Mapping[str, Any]) -> str:
    """For a document: a table a group and scene, and the machine above."""
    bench = record["bench"]
    about = "{size}³ voxels, {views} views, {kvp:g} kV, {photons:g} photons, {seeds} seed(s)".format(**bench)
    parts = [f"{machine(record)}; {about}; mean ± standard deviation."]
    parts += [f"**{head}**\n\n{markdown_table(*table)}" for head, table in _tables(record)]
    return "\n\n".join(parts) + "\n"


def _tables(record: Mapping[str, Any]) -> list[tuple[str, tuple[list[str], list[list[str]]]]]:
    tables = []
    headings = ["variant", *(heading for _, heading, _ in _COLUMNS)]
    for name in record["bench"]["groups"]:
        labels = [DEFAULT.label, *(variant.label for variant in GROUPS.get(name, ()))]
        for scene in dict.fromkeys(run["scene"] for run in record["runs"]) if name != AFFINE else ():
            here = [run for run in record["runs"] if run["scene"] == scene and run["method"] in labels]
            rows = [_row(repeated) for repeated in grouped(here, ("method",))]
            tables.append((f"{name}: {scene}", (headings, rows)))
    if record["affine"]:
        tables.append(("affine: error of a ray's line integral", _affine_table(record["affine"])))
    return tables


def _row(repeated: Sequence[Mapping[str, Any]]) -> list[str]:
    label, good = repeated[0]["method"], [run for run in repeated if run["seconds"] is not None]
    if not good:
        return [f"{label}: {without_figures(repeated[0])}", *["–"] * len(_COLUMNS)]
    return [label, *(cell(good, key, form) for key, _, form in _COLUMNS)]


def _affine_table(entries: Sequence[Mapping[str, Any]]) -> tuple[list[str], list[list[str]]]:
    widths = list(dict.fromkeys(entry["width"] for entry in entries))
    rows = []
    for entry, *others in grouped(entries, ("half_angle_degrees",)):
        figures = [f"{each['rms_percent']:.2g} / {each['largest_percent']:.2g}" for each in (entry, *others)]
        rows.append([f"{entry['half_angle_degrees']:g}°", *figures])
    return ["half angle", *(f"width {width:g}, rms / largest (%)" for width in widths)], rows

"""Tables and figures of the plan's benchmark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import groupby
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.bench.recon_report import machine
from tomo_polysplat.bench.runs import without_figures
from tomo_polysplat.bench.tables import markdown_table
from tomo_polysplat.files import replacing
from tomo_polysplat.report.style import ACCENT, INK, QUIET, plain_log

__all__ = ["as_markdown", "write_figure"]

Runs = Sequence[Mapping[str, Any]]


def as_markdown(record: Mapping[str, Any]) -> str:
    """A table a scan, one of what is ahead of the plan, one of the stopping rule, and the machine above."""
    about = "{size} voxels along the scene, {views} views, seed {seed}".format(**record["bench"])
    parts = [f"{machine(record)}; {about}."]
    for name in record["bench"]["scans"]:
        runs = [run for run in record["runs"] if run["scan"] == name]
        if runs:
            parts.append(f"**{name}**\n\n{_table(runs)}")
        again = [run for run in record["again"] if run["scan"] == name]
        if again:
            parts.append(f"Ahead of the plan, on scans of other noise:\n\n{_again_table(runs, again)}")
    if record["stopping"]:
        parts.append(f"**Held-out rays**\n\n{_stopping_table(record['stopping'])}")
    return "\n\n".join(parts) + "\n"


def _table(runs: Runs) -> str:
    """The first run is that of the plan, to which the others are compared."""
    headings = ["", "Seeds", "s", "CPU s", "CPU time", "PSNR", "PSNR all"]
    return markdown_table(headings, [_row(run, runs[0]) for run in runs])


def _again_table(runs: Runs, again: Runs) -> str:
    """What those ahead of the plan gain with the first scan's noise and with other noise."""
    # The plan is the first on every scan.
    scans = [runs, *(list(group) for _, group in groupby(again, key=itemgetter("seed")))]
    rows = []
    for method in dict.fromkeys(run["method"] for run in again if run["method"] != again[0]["method"]):
        pairs = [(run, scan[0]) for scan in scans for run in scan if run["method"] == method]
        pairs = [(one, plan) for one, plan in pairs if None not in (one["seconds"], plan["seconds"])]
        row = [method, str(len(pairs))]
        for key in ("psnr", "psnr_all"):
            gains = [one[key] - plan[key] for one, plan in pairs]
            row.append(f"{np.mean(gains):+.2f} ({min(gains):+.2f} to {max(gains):+.2f})")
        rows.append(row)
    return markdown_table(["", "Scans", "PSNR, mean", "PSNR all, mean"], rows)


def _row(run: Mapping[str, Any], plan: Mapping[str, Any]) -> list[str]:
    label = "the plan" if run is plan else run["method"]
    if run["seconds"] is None or plan["seconds"] is None:
        return [f"{label}: {without_figures(run) if run['seconds'] is None else 'no plan'}", *["–"] * 6]
    seeds = str(run["about"]["plan"]["gaussians"]["value"])
    figures = [f"{run['seconds']:.1f}", f"{run['cpu_seconds']:.1f}"]
    figures.append(f"x {run['cpu_seconds'] / plan['cpu_seconds']:.2f}")
    for key in ("psnr", "psnr_all"):
        change = "" if run is plan else f" ({run[key] - plan[key]:+.2f})"
        figures.append(f"{run[key]:.2f}{change}")
    return [label, seeds, *figures]


def _stopping_table(entries: Sequence[Mapping[str, Any]]) -> str:
    headings = [
        "scan",
        "passes",
        "the rule stops after",
        "it keeps",
        "best",
        "missed (dB)",
        "rank correlation",
    ]
    rows = []
    for entry in entries:
        rule = entry["rule"]
        if rule is None:
            rows.append([entry["scan"], *["–"] * 6])
            continue
        correlation = rule["correlation"]
        numbers = [str(rule[key]) for key in ("passes", "stops_after", "keeps", "best")]
        known = "–" if correlation is None else f"{correlation:.2f}"
        rows.append([entry["scan"], *numbers, f"{rule['missed_db']:.2f}", known])
    return markdown_table(headings, rows)


def write_figure(path: Path, record: Mapping[str, Any]) -> None:
    """Error of the held-out rays and of the volume, pass by pass, a panel a scan, as a PNG."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    entries = record["stopping"]
    figure = Figure(figsize=(3.1 * max(1, len(entries)), 3.3), layout="constrained")
    panels = np.atleast_1d(figure.subplots(1, max(1, len(entries))))
    for axis, entry in zip(panels, entries):
        for key, colour, label in (
            ("held_out", QUIET, "held-out rays"),
            ("rmse", ACCENT, "volume without metal"),
        ):
            points = [(n, p[key]) for n, p in enumerate(entry["history"], 1) if p[key]]
            if points:
                passes, errors = np.array(points).T
                axis.plot(passes, errors / errors.min(), "o-", color=colour, label=label, markersize=3)
        if entry["rule"] is not None:
            axis.axvline(entry["rule"]["keeps"], color=INK, linewidth=0.8, label="kept by the rule")
            axis.set_title(f"{entry['scan']}: {entry['rule']['missed_db']:.2f} dB missed", fontsize=9)
        axis.set(xlabel="pass over the views")
        axis.xaxis.set_major_locator(MaxNLocator(5, integer=True))
        plain_log(axis.yaxis)
        axis.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel("error over its smallest")
    panels[0].legend(frameon=False, fontsize=8)
    with replacing(path, overwrite=True) as temporary:
        figure.savefig(temporary, dpi=130, format="png")

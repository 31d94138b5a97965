"""The record of `bench scale` as a table, and as a figure of cost and error against size."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from statistics import fmean
from typing import Any

from tomo_polysplat.bench.recon_report import colour, dress, machine
from tomo_polysplat.bench.runs import without_figures
from tomo_polysplat.bench.scale import CONDITION
from tomo_polysplat.bench.tables import Column, cell, grouped, markdown_table, text_table
from tomo_polysplat.files import replacing
from tomo_polysplat.report.style import plain_log

__all__ = ["as_markdown", "as_text", "write_figure"]

_COLUMNS: tuple[Column, ...] = (
    ("seconds", "seconds", "{:.1f}"),
    ("cpu_seconds", "CPU s", "{:.1f}"),
    ("gib", "GiB", "{:.2f}"),
    ("psnr", "PSNR without metal", "{:.1f}"),
    ("psnr_all", "everywhere", "{:.1f}"),
    ("ssim", "SSIM", "{:.3f}"),
    ("dice", "Dice", "{:.3f}"),
    ("dice_near_metal", "near metal", "{:.3f}"),
    ("contrast", "contrast", "{:.2f}"),
    ("noise", "noise", "{:.3f}"),
    ("gaussians", "Gaussians", "{:.3g}"),
)
_HEADINGS = ("scan", "method", *(heading for _, heading, _ in _COLUMNS))


def as_text(record: Mapping[str, Any]) -> str:
    """For a terminal."""
    return text_table(_HEADINGS, _rows(record))


def as_markdown(record: Mapping[str, Any]) -> str:
    """For a page; means over the seeds with their standard deviation."""
    return f"{machine(record)}\n\n{markdown_table(_HEADINGS, _rows(record))}\n"


def write_figure(path: Path, record: Mapping[str, Any]) -> None:
    """Seconds, bytes and PSNR against voxels, means over kinds and seeds of scans with metal, else of all."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.6, 3.6), layout="constrained")
    runs = [_flat(run) for run in record["runs"] if run["seconds"] is not None]
    runs = [run for run in runs if run["metal"]] or runs
    kinds = (("seconds", "seconds"), ("gib", "GiB at the peak"), ("psnr", "PSNR without metal (dB)"))
    for axis, (key, label) in zip(figure.subplots(1, 3), kinds):
        for group in grouped(runs, ("method",)):
            name = group[0]["method"]
            points = [
                (some[0]["size"], fmean(run[key] for run in some if run[key] is not None))
                for some in grouped(group, ("size",))
                if any(run[key] is not None for run in some)
            ]
            if points:
                axis.plot(*zip(*sorted(points)), color=colour(name, record), marker="o", label=name)
        axis.set(xlabel="voxels per edge", ylabel=label)
        plain_log(axis.xaxis)
        if key != "psnr":
            plain_log(axis.yaxis)
        dress(axis)
    handles, labels = axis.get_legend_handles_labels()
    if handles:
        figure.legend(handles, labels, loc="outside lower center", ncol=len(labels), frameon=False)
    figure.suptitle(f"{', '.join(record['bench']['kinds'])}; {machine(record)}", fontsize=10)
    with replacing(path, overwrite=True) as temporary:
        figure.savefig(temporary, format="png", dpi=150)


def _flat(run: Mapping[str, Any]) -> dict[str, Any]:
    memory = run.get("peak_memory_bytes")
    return {
        **run,
        "gib": None if memory is None else memory / 2**30,
        "gaussians": run["about"].get("gaussians"),
    }


def _rows(record: Mapping[str, Any]) -> list[list[str]]:
    rows = []
    for group in grouped([_flat(run) for run in record["runs"]], (*CONDITION, "method")):
        first = group[0]
        name = f"{first['kind']} {first['size']}" + ("" if first["metal"] else ", no metal")
        good = [run for run in group if run["seconds"] is not None]
        told = [cell(good, key, form) for key, _, form in _COLUMNS]
        if not good:
            told = [without_figures(first), *[""] * (len(_COLUMNS) - 1)]
        rows.append([name, first["method"], *told])
    return rows

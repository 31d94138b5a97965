"""The record of a benchmark of reconstructions as a table and as figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tomo_polysplat.bench.methods import METHODS
from tomo_polysplat.bench.runs import without_figures
from tomo_polysplat.files import replacing
from tomo_polysplat.report.style import ACCENT, OURS, QUIET, plain_log

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["as_text", "colour", "dress", "error_figure", "machine", "write_figures"]

_COLOURS = (
    "#9a9a9a",
    "#5f5f5f",
    "#c77c2e",
    "#8a5fa8",
    "#2f6fb0",
    "#b04a4a",
    "#7a8b2f",
    "#3f8f8f",
    "#d08bb0",
    "#8c6d4f",
)
_FORM = "{:<8} {:>5} {:<11} {:>7} {:>8} {:>8} {:>8} {:>7} {:>9} {:>8}"


def as_text(record: Mapping[str, Any]) -> str:
    """The runs as a table for a terminal, with what the warm-up took below."""
    heads = ("scene", "size", "method", "budget", "seconds", "PSNR", "PSNR all", "SSIM", "rms 1/cm", "GiB")
    lines = [_FORM.format(*heads)]
    for run in record["runs"]:
        budget = "-" if run["budget"] is None else f"{run['budget']:g}"
        if run["seconds"] is None:
            line = f"{run['scene']:<8} {run['size']:>5} {run['method']:<11} {budget:>7}"
            lines.append(f"{line} {without_figures(run)}")
            continue
        memory = "-" if run["peak_memory_bytes"] is None else f"{run['peak_memory_bytes'] / 2**30:.2f}"
        numbers = (f"{run['seconds']:.2f}", f"{run['psnr']:.2f}", f"{run['psnr_all']:.2f}")
        errors = (f"{run['ssim']:.4f}", f"{run['rmse']:.5f}")
        lines.append(
            _FORM.format(run["scene"], str(run["size"]), run["method"], budget, *numbers, *errors, memory)
        )
    for entry in record["warm_up"]:
        cold, warm = (_seconds(entry[f"{kind}_seconds"]) for kind in ("cold", "warm"))
        lines.append(f"warm-up, {entry['size']}, few views: {entry['method']} {cold} cold, {warm} warm")
    return "\n".join(lines)


def _seconds(value: float | None) -> str:
    return "failed" if value is None else f"{value:.2f} s"


def write_figures(folder: Path, record: Mapping[str, Any]) -> list[Path]:
    """Error against seconds for every scan, and seconds against size for every scene; the files written."""
    scans = list(dict.fromkeys((run["scene"], run["size"]) for run in record["runs"]))
    written = [
        _save(error_figure(record, scene, size), folder / f"recon-error-{scene}-{size}.png")
        for scene, size in scans
    ]
    if len({size for _, size in scans}) > 1:
        written += [_size_figure(folder, record, scene) for scene in dict.fromkeys(s for s, _ in scans)]
    return written


def error_figure(record: Mapping[str, Any], scene: str, size: int) -> Figure:
    """Errors without metal and everywhere against seconds, of one scan."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10.6, 4.2), layout="constrained")
    here = [r for r in record["runs"] if (r["scene"], r["size"]) == (scene, size) and r["seconds"]]
    for axis, key, label in zip(figure.subplots(1, 2), ("psnr", "psnr_all"), ("without metal", "everywhere")):
        for name in dict.fromkeys(run["method"] for run in here):
            points = sorted((run["seconds"], run[key]) for run in here if run["method"] == name)
            _plot(axis, name, points, record, "o", "")
            curves = [
                c for c in record["curves"] if (c["scene"], c["size"], c["method"]) == (scene, size, name)
            ]
            for curve in curves:
                course = [(p["seconds"], p[key]) for p in curve["history"]]
                # Small dots, as a course of a single pass has no line.
                axis.plot(*zip(*course), color=colour(name, record), marker=".", markersize=4)
        axis.set(xlabel="seconds, from projections to volume", ylabel=f"PSNR {label} (dB)")
        plain_log(axis.xaxis)
        dress(axis)
    handles, labels = axis.get_legend_handles_labels()
    if handles:
        figure.legend(
            handles, labels, loc="outside lower center", ncol=len(labels), frameon=False, fontsize=8
        )
    figure.suptitle(
        f"{scene}, {size}³ voxels, {record['bench']['views']} views; {machine(record)}", fontsize=10
    )
    return figure


def _size_figure(folder: Path, record: Mapping[str, Any], scene: str) -> Path:
    """For methods with several budgets, the run with the smallest error."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.2, 4.2), layout="constrained")
    axis = figure.subplots()
    here = [run for run in record["runs"] if run["scene"] == scene and run["seconds"]]
    for name in dict.fromkeys(run["method"] for run in here):
        best: dict[int, Mapping[str, Any]] = {}
        for run in (run for run in here if run["method"] == name):
            if run["size"] not in best or run["psnr"] > best[run["size"]]["psnr"]:
                best[run["size"]] = run
        _plot(axis, name, [(size, best[size]["seconds"]) for size in sorted(best)], record, "o", "-")
    axis.set(xscale="log", xlabel="voxels per edge", ylabel="seconds of the run of least error")
    plain_log(axis.yaxis)
    sizes = sorted({run["size"] for run in here})
    axis.set_xticks(sizes, [str(size) for size in sizes])
    axis.set_xticks([], minor=True)
    dress(axis)
    figure.legend(loc="outside right center", frameon=False, fontsize=8)
    figure.suptitle(f"{scene}; {machine(record)}", fontsize=10)
    return _save(figure, folder / f"recon-seconds-{scene}.png")


def _plot(
    axis: Axes,
    name: str,
    points: Sequence[tuple[float, float]],
    record: Mapping[str, Any],
    marker: str,
    line: str,
) -> None:
    axis.plot(
        *zip(*points), marker=marker, linestyle=line, color=colour(name, record), label=METHODS[name].label
    )


def colour(name: str, record: Mapping[str, Any]) -> str:
    """Of a method, the same in every figure of a record."""
    others = [method for method in record["bench"]["methods"] if method != OURS]
    return ACCENT if name == OURS else _COLOURS[others.index(name) % len(_COLOURS)]


def machine(record: Mapping[str, Any]) -> str:
    """What a record was measured on."""
    environment = record["environment"]
    if record["bench"]["device"].startswith("cuda") and environment["gpus"]:
        return environment["gpus"][0]
    return f"{environment['cpu']}, {environment['threads']} threads"


def dress(axis: Axes) -> None:
    """Axes as all figures have them."""
    axis.spines[["top", "right"]].set_visible(False)
    axis.grid(color=QUIET, alpha=0.2, linewidth=0.6)


def _save(figure: Any, path: Path) -> Path:
    with replacing(path, overwrite=True) as temporary:
        figure.savefig(temporary, dpi=110)
    return path

"""The record of the accuracy benchmark as tables and as one self-contained page."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tomo_polysplat.bench.accuracy import CONDITION, Volumes
from tomo_polysplat.bench.methods import METHODS
from tomo_polysplat.bench.recon_report import colour, dress, error_figure, machine
from tomo_polysplat.bench.runs import without_figures
from tomo_polysplat.bench.tables import Column, cell, grouped, html_table, markdown_table, text_table
from tomo_polysplat.files import write_text
from tomo_polysplat.report.figures import png_bytes, slices_figure
from tomo_polysplat.report.html import image, page
from tomo_polysplat.report.slices import display_window, planes_through
from tomo_polysplat.scan.scan import Scan

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["as_markdown", "as_text", "slices_png", "write_page"]

Record = Mapping[str, Any]

_COLUMNS: tuple[Column, ...] = (
    ("psnr", "PSNR", "{:.1f}"),
    ("psnr_all", "PSNR all", "{:.1f}"),
    ("ssim_all", "SSIM all", "{:.4f}"),
    ("rmse", "rms 1/cm", "{:.4f}"),
    ("soft_bias", "soft %", "{:+.1f}"),
    ("metal_bias", "metal %", "{:+.1f}"),
    ("metal_mass", "mass %", "{:+.1f}"),
    ("edge_width", "edge", "{:.2f}"),
    ("seconds", "seconds", "{:.1f}"),
    ("cpu_seconds", "CPU s", "{:.1f}"),
    ("gib", "GiB", "{:.2f}"),
)
_STOPPING: tuple[Column, ...] = (
    ("passes", "passes watched", "{:.0f}"),
    ("stops_after", "the rule stops after", "{:.0f}"),
    ("keeps", "it keeps pass", "{:.0f}"),
    ("best", "best pass", "{:.0f}"),
    ("missed_db", "missed (dB)", "{:.2f}"),
    ("correlation", "rank correlation", "{:.2f}"),
)
_LEGEND = """<p class="note">PSNR in dB of the voxels without metal, and of all; SSIM of all. Soft: error of the
mean of one soft material away from metal; metal: of its inside, where it has one; mass: of all attenuation in
metal and two voxels around it. Edge: width in voxels, from 90 to 10 %, of the mean profile across the metal's
surface. CPU seconds count every thread.</p>"""
_TRUST = "Held-out rays against the truth"


def title(condition: Record) -> str:
    """A condition in words."""
    return "{scene}, {size}³ voxels, {views} views, {kvp:g} kV, {photons:g} photons".format(**condition)


def as_text(record: Record) -> str:
    """For a terminal."""
    parts = [f"{head}\n{text_table(*table)}" for head, table in _tables(record)]
    return "\n\n".join([*parts, *_reasons(record)])


def as_markdown(record: Record) -> str:
    """For a README: one table a condition, and the machine above."""
    parts = [f"{machine(record)}; {record['bench']['seeds']} seed(s), mean ± standard deviation."]
    parts += [f"**{head}**\n\n{markdown_table(*table)}" for head, table in _tables(record)]
    return "\n\n".join([*parts, *_reasons(record)]) + "\n"


def _reasons(record: Record) -> list[str]:
    """Why methods have no figures, each reason once."""
    bare = [run for run in record["runs"] if run["seconds"] is None]
    return list(dict.fromkeys(f"{METHODS[run['method']].label} {without_figures(run)}" for run in bare))


def _tables(record: Record) -> list[tuple[str, tuple[list[str], list[list[str]]]]]:
    """Headed tables: the errors of each condition, then what the stopping rule misses."""
    tables = [(_heading(runs), _errors(runs)) for runs in grouped(record["runs"], CONDITION)]
    return [*tables, (_TRUST, _kept(record))] if record["stopping"] else tables


def _kept(record: Record) -> tuple[list[str], list[list[str]]]:
    rows = [
        [title(kept), kept["method"], *(cell([kept], key, form) for key, _, form in _STOPPING)]
        for kept in record["stopping"]
    ]
    return ["scan", "method", *(heading for _, heading, _ in _STOPPING)], rows


def _heading(runs: Sequence[Record]) -> str:
    true = cell(runs[:1], "edge_width_true", "{:.2f}")
    return title(runs[0]) + ("" if true == "–" else f"; true edge {true} voxels")


def _errors(runs: Sequence[Record]) -> tuple[list[str], list[list[str]]]:
    rows = []
    for repeated in grouped(runs, ("method", "budget")):
        first = repeated[0]
        name = METHODS[first["method"]].label
        name += "" if first["budget"] is None else f", {first['budget']:g} s"
        good = [run for run in repeated if run["seconds"] is not None]
        if not good:
            rows.append([f"{name} ({without_figures(first).partition(':')[0]})", *["–"] * len(_COLUMNS)])
            continue
        name += "" if len(good) == len(repeated) else f" ({len(repeated) - len(good)} failed)"
        sized = [{**run, "gib": (run["peak_memory_bytes"] or 0) / 2**30 or None} for run in good]
        rows.append([name, *(cell(sized, key, form) for key, _, form in _COLUMNS)])
    return ["method", *(heading for _, heading, _ in _COLUMNS)], rows


def slices_png(scan: Scan, energy: float | None, volumes: Volumes) -> bytes:
    """Slices of the truth and of every volume through the metal, with one window."""
    assert scan.truth is not None
    window = display_window(scan.truth, scan.metal_mask)
    planes = planes_through(scan.truth if scan.metal_mask is None else scan.metal_mask)[:2]
    shown = [("truth", scan.truth), *volumes]
    return png_bytes(slices_figure(shown, scan.unit, energy, window, planes), dpi=70)


def write_page(path: Path, record: Record, pictures: Mapping[tuple[Any, ...], bytes]) -> None:
    """Write the page: plots, slices and table of each condition.

    Parameters
    ----------
    path : path
        Replaced if it exists.
    record : mapping
        Of `run_accuracy_bench`.
    pictures : mapping
        PNG of the slices by the values of ``CONDITION``.
    """
    body = ["<h1>How accurate the reconstructions are</h1>", f'<p class="note">{_about(record)}</p>', _LEGEND]
    for runs in grouped(record["runs"], CONDITION):
        key = tuple(runs[0][name] for name in CONDITION)
        part = _part(record, key)
        body += [f"<h2>{html.escape(_heading(runs))}</h2>", html_table(*_errors(runs))]
        body.append(image(png_bytes(error_figure(part, key[0], key[1])), "error against seconds"))
        if part["curves"]:
            body.append(image(png_bytes(_truth_figure(part)), "held-out error against true error"))
        if key in pictures:
            body.append(image(pictures[key], "slices of the truth and of every method, one window"))
    if record["stopping"]:
        body += [f"<h2>{_TRUST}</h2>", html_table(*_kept(record))]
    body += [f'<p class="note">{html.escape(words)}</p>' for words in _reasons(record)]
    write_text(path, page("tomo-polysplat accuracy", body), overwrite=True)


def _about(record: Record) -> str:
    commit = record["environment"]["commit"]
    words = f"{machine(record)}; commit {commit}; mean ± standard deviation over {record['bench']['seeds']} seed(s)"
    return html.escape(words)


def _part(record: Record, key: tuple[Any, ...]) -> dict[str, Any]:
    """One condition as a record of the benchmark of reconstructions."""

    def here(name: str) -> list[Record]:
        return [entry for entry in record[name] if tuple(entry[k] for k in CONDITION) == key]

    bench = {**record["bench"], **dict(zip(CONDITION, key))}
    return {**record, "bench": bench, "runs": here("runs"), "curves": here("curves")}


def _truth_figure(part: Record) -> Figure:
    """Held-out error against the true one, pass after pass."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.6), layout="constrained")
    axis = figure.subplots()
    for curve in part["curves"]:
        points = [(p["held_out"], p["psnr"]) for p in curve["history"] if p["held_out"] is not None]
        if points:
            name = curve["method"]
            axis.plot(*zip(*points), ".-", color=colour(name, part), label=METHODS[name].label)
            axis.plot(*points[-1], "o", color=colour(name, part))
    axis.set(xlabel="error of the rays held out", ylabel="PSNR without metal (dB)")
    dress(axis)
    if axis.lines:
        axis.legend(frameon=False, fontsize=8, title="passes; the dot is the last")
    return figure

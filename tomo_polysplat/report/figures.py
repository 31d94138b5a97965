"""Figures for people: every panel of a figure has the same window, and says it."""

from __future__ import annotations

import io
import os
import textwrap
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, require_shape
from tomo_polysplat.files import replacing
from tomo_polysplat.report import table as tables
from tomo_polysplat.report.slices import Plane, display_window, planes_through
from tomo_polysplat.report.style import ACCENT, INK, OURS, QUIET, full_name, plain_log

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

__all__ = ["comparison", "comparison_figure", "history_figure", "png_bytes", "slices_figure"]

PANEL = 2.35  # inches


# One parameter for each option that a caller names.
def comparison_figure(
    path: str | os.PathLike,
    panels: Sequence[tuple[str, np.ndarray]],
    truth: np.ndarray,
    metal_mask: np.ndarray | None,
    unit: str,
    energy: float | None,
    table: tables.Table,
    *,
    title: str = "One scan, several reconstructions, one grey scale",
    overwrite: bool = False,
) -> None:
    """Write what `comparison` draws to an image, by its ending (``.png``, ``.pdf``, ``.svg``)."""
    figure = comparison(panels, truth, metal_mask, unit, energy, table, title=title)
    _write(figure, path, overwrite)


# One parameter for each option that a caller names.
def comparison(
    panels: Sequence[tuple[str, np.ndarray]],
    truth: np.ndarray,
    metal_mask: np.ndarray | None,
    unit: str,
    energy: float | None,
    table: tables.Table,
    *,
    title: str,
) -> Figure:
    """Several reconstructions beside the truth: slices through the metal, errors, a table.

    Parameters
    ----------
    panels : sequence of (name, volume)
        Volumes (z, y, x) like `truth`; ``"fdk"``, ``"fdk-water"``, ``"mono"`` and ``"polysplat"`` get a full
        name.
    truth : array, shape (z, y, x)
        True attenuation in 1/`unit`.
    metal_mask : bool array, shape (z, y, x), or None
        Where the slices go through and what the window leaves out.
    unit, energy
        Unit of length, and photon energy in keV of every volume (None when unknown).
    table : sequence of mappings
        ``name``, ``seconds``, ``psnr``, ``psnr_all``, ``ssim`` and ``rmse`` of each method.
    """
    from matplotlib.figure import Figure

    metal = np.zeros(truth.shape, bool) if metal_mask is None else np.asarray(metal_mask, bool)
    for name, volume in panels:
        require_shape(f"panel {name!r}", volume, truth.shape, "(z, y, x) of the truth")
    planes = planes_through(metal)[:2]
    window = display_window(truth, metal)
    heights = [_height(plane, truth.shape) for plane in planes] + [_height(planes[0], truth.shape)]
    columns = len(panels) + 1
    table_height = 0.55 + 0.24 * len(table)
    size = (PANEL * columns + 0.9, sum(h * PANEL for h in heights) + table_height + 1.1)
    figure = Figure(figsize=size, facecolor="white", layout="constrained")
    figure.suptitle(title, x=0.01, ha="left", fontsize=15, fontweight="bold", color=INK)
    ratios = [size[1] - table_height - 0.4, table_height]
    upper, lower = np.asarray(figure.subfigures(2, 1, height_ratios=ratios), object)
    axes = upper.subplots(len(heights), columns, height_ratios=heights, squeeze=False)
    shown = [("truth", truth), *panels]
    grey = _fill_slices(axes[:-1], shown, planes, window)
    red_blue = _fill_errors(axes[-1], shown, planes[0], truth, window[1])
    scale = "" if energy is None else f" at {energy:.1f} keV"
    upper.colorbar(grey, ax=axes[:-1], fraction=0.02, pad=0.01, label=f"attenuation{scale} (1/{unit})")
    upper.colorbar(red_blue, ax=axes[-1], fraction=0.02, pad=0.01, label=f"error (1/{unit})")
    tables.draw(lower.subplots(), table, unit)
    return figure


def _height(plane: Plane, shape: tuple[int, ...]) -> float:
    rows, columns = (n for axis, n in enumerate(shape) if axis != plane.axis)
    return rows / columns


def _fill_slices(axes: np.ndarray, shown: list, planes: list[Plane], window: tuple[float, float]) -> Any:
    image: Any = None
    for row, plane in zip(axes, planes):
        for axis, (name, volume) in zip(row, shown):
            image = axis.imshow(plane.of(volume), origin="lower", cmap="gray", vmin=window[0], vmax=window[1])
            _bare(axis)
            if plane is planes[0]:
                _head(axis, name)
        row[0].set_ylabel(f"{plane.name} slice\nthrough the metal", fontsize=9, color=QUIET)
    return image


def _fill_errors(axes: np.ndarray, shown: list, plane: Plane, truth: np.ndarray, top: float) -> Any:
    image: Any = None
    for axis, (_, volume) in zip(axes[1:], shown[1:]):
        error = plane.of(volume) - plane.of(truth)
        image = axis.imshow(error, origin="lower", cmap="RdBu_r", vmin=-0.5 * top, vmax=0.5 * top)
        _bare(axis)
    axes[0].axis("off")
    note = "Error of the axial slice:\nred is too bright,\nblue too dark,\nwhite is right."
    axes[0].text(
        1.0, 0.5, note, ha="right", va="center", fontsize=9, color=QUIET, transform=axes[0].transAxes
    )
    return image


def _head(axis: Axes, name: str) -> None:
    ours = name == OURS
    # Two lines of about equal length keep neighbouring titles apart.
    label = textwrap.fill(full_name(name), width=18)
    colour, weight = (ACCENT, "bold") if ours else (INK, "normal")
    axis.set_title(label, fontsize=11, color=colour, fontweight=weight)


def _bare(axis: Axes) -> None:
    axis.set_xticks([])
    axis.set_yticks([])
    for side in axis.spines.values():
        side.set_visible(False)


def slices_figure(
    volumes: Sequence[tuple[str, np.ndarray]],
    unit: str,
    energy: float | None,
    window: tuple[float, float],
    planes: Sequence[Plane],
) -> Figure:
    """Orthogonal slices of volumes (z, y, x), one row a volume, all with the same `window`."""
    from matplotlib.figure import Figure

    if not volumes:
        raise fail("volumes", "at least one volume", "none")
    shape = volumes[0][1].shape
    heights = max(_height(plane, shape) for plane in planes)
    figure = Figure(
        figsize=(3.2 * len(planes) + 1.0, (3.2 * heights + 0.3) * len(volumes)), layout="constrained"
    )
    axes = figure.subplots(len(volumes), len(planes), squeeze=False)
    image: Any = None
    for row, (name, volume) in zip(axes, volumes):
        for axis, plane in zip(row, planes):
            image = axis.imshow(plane.of(volume), origin="lower", cmap="gray", vmin=window[0], vmax=window[1])
            axis.set_title(f"{name}, {plane.name} {plane.index}", fontsize=9, color=INK)
            _bare(axis)
    scale = "" if energy is None else f" at {energy:.1f} keV"
    figure.colorbar(image, ax=axes, fraction=0.03, pad=0.01, label=f"attenuation{scale} (1/{unit})")
    return figure


def history_figure(history: Sequence[Mapping[str, Any]]) -> Figure:
    """Error against seconds: the fit's loss and the error of the rays held out of it."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 3.0), layout="constrained")
    axis = figure.subplots()
    for key, label, colour in (
        ("loss", "rays used in the fit", QUIET),
        ("held_out", "rays held out", ACCENT),
    ):
        points = [
            (e["seconds"], e[key]) for e in history if e.get(key) is not None and e.get("seconds") is not None
        ]
        if points:
            seconds, values = zip(*points)
            axis.plot(seconds, values, marker="." if len(points) < 60 else "", color=colour, label=label)
    axis.set(xlabel="seconds", ylabel="error of the projections")
    axis.spines[["top", "right"]].set_visible(False)
    if axis.lines:
        axis.legend(frameon=False)
        if all(np.all(np.asarray(line.get_ydata()) > 0) for line in axis.lines):
            plain_log(axis.yaxis)
    else:
        axis.text(0.5, 0.5, "no history was recorded", ha="center", transform=axis.transAxes, color=QUIET)
    return figure


def png_bytes(figure: Figure, dpi: int = 110) -> bytes:
    """A figure as a PNG image."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi)
    return buffer.getvalue()


def _write(figure: Figure, path: str | os.PathLike, overwrite: bool) -> None:
    with replacing(path, overwrite=overwrite) as temporary:
        figure.savefig(temporary, dpi=150)

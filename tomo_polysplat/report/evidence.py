"""Figures of how well the rays are explained: by view, and by pixel."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.report.style import ACCENT, QUIET, SAFE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tomo_polysplat.result.residuals import Residuals

__all__ = ["by_pixel_figure", "by_view_figure"]

# The maps are flat for the share of pixels above: one dead pixel is not to set the scale.
_SATURATED = 0.995


def by_view_figure(residuals: Residuals) -> Figure:
    """Root mean square residual of every view looked at."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.4, 2.4), layout="constrained")
    axis = figure.subplots()
    marker = "o" if len(residuals.views) < 80 else ""
    axis.plot(
        residuals.views,
        residuals.by_view,
        color=ACCENT,
        marker=marker,
        markersize=3,
        linewidth=1,
        label="all rays",
    )
    if np.isfinite(residuals.held_out).any():
        unseen: dict[str, Any] = {"marker": "x", "markersize": 4, "linestyle": "", "label": "rays held out"}
        axis.plot(residuals.views, residuals.held_out, color=SAFE[1], **unseen)
    if residuals.noisy:
        axis.axhline(1.0, color=QUIET, linestyle="--", linewidth=0.9, label="noise alone")
    axis.legend(frameon=False, fontsize=8, ncols=3)
    shown = np.append(residuals.by_view, residuals.held_out)
    axis.set_ylim(0, 1.25 * max(1.0, _largest(shown)))
    axis.set(xlabel="view", ylabel=f"rms residual\n({residuals.unit})")
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def by_pixel_figure(residuals: Residuals) -> Figure:
    """Root mean square and mean residual of every pixel of the detector over the views."""
    from matplotlib.figure import Figure

    rows, columns = residuals.by_pixel.shape
    flat = rows == 1
    height = 2.2 if flat else min(5.0, 1.2 + 3.0 * rows / columns)
    figure = Figure(figsize=(7.8, height), layout="constrained")
    left, right = figure.subplots(1, 2)
    titles = ("rms over the views", "mean over the views (model - measured)")
    if flat:
        across = np.arange(columns) * residuals.block
        left.plot(across, residuals.by_pixel[0], color=ACCENT, linewidth=1)
        right.plot(across, residuals.bias[0], color=ACCENT, linewidth=1)
        left.set_xlabel("column")
        right.set_xlabel("column")
    else:
        top = _largest(residuals.by_pixel)
        span = _largest(np.abs(residuals.bias))
        _map(figure, left, residuals, residuals.by_pixel, ("cividis", 0.0, top))
        _map(figure, right, residuals, residuals.bias, ("PuOr", -span, span))
    for axis, title in zip((left, right), titles):
        axis.set_title(title, fontsize=9)
    return figure


def _map(
    figure: Figure, axis: Any, residuals: Residuals, image: np.ndarray, how: tuple[str, float, float]
) -> None:
    rows, columns = (n * residuals.block for n in image.shape)
    name, low, high = how
    shown = axis.imshow(image, cmap=name, vmin=low, vmax=high, extent=(0, columns, rows, 0), aspect="equal")
    axis.set_facecolor("0.85")
    axis.tick_params(labelsize=7)
    axis.set_xlabel("column", fontsize=8)
    axis.set_ylabel("row", fontsize=8)
    figure.colorbar(shown, ax=axis, shrink=0.9, label=residuals.unit if low == 0 else None)


def _largest(values: np.ndarray) -> float:
    known = values[np.isfinite(values)]
    return max(float(np.quantile(known, _SATURATED)), 1e-6) if known.size else 1.0

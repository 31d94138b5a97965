"""How fine and how faint a result is: a section of the report, where that was measured."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.report.figures import png_bytes
from tomo_polysplat.report.page import image, text
from tomo_polysplat.report.style import ACCENT, QUIET

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from tomo_polysplat.result.detail import Contrast, Resolution

__all__ = ["detail"]

# The map is flat for the share of voxels above.
_SATURATED = 0.998


def detail(resolution: Resolution | None, contrast: Contrast | None) -> list[str]:
    """Pieces of HTML; none where nothing was measured."""
    parts: list[str] = []
    if resolution is not None:
        parts += [f"<p>{text(resolution.describe())}</p>"]
        parts += [image(png_bytes(_shells(resolution)), "correlation of two halves of the views by fineness")]
        note = (
            "Distrust what is bright here: the standard deviation that the difference of the two halves tells, in"
            f" 1/{resolution.unit}. What both halves have wrong in the same way is not seen."
        )
        parts += [f'<p class="note">{text(note)}</p>']
        parts += [image(png_bytes(_doubt(resolution)), "map of where two halves of the views disagree")]
    if contrast is not None:
        parts += [f"<p>{text(contrast.describe())}</p>"]
    return ["<h2>How fine, and how faint</h2>", *parts] if parts else []


def _shells(resolution: Resolution) -> Figure:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7.4, 2.4), layout="constrained")
    axis = figure.subplots()
    axis.plot(resolution.curve.frequency, resolution.curve.correlation, color=ACCENT, linewidth=1.2)
    axis.axhline(1 / 7, color=QUIET, linestyle="--", linewidth=0.9)
    axis.axvline(1 / resolution.period, color=QUIET, linewidth=0.9)
    axis.set_ylim(-0.1, 1.05)
    axis.set(xlabel=f"cycles per {resolution.unit}", ylabel="correlation")
    axis.spines[["top", "right"]].set_visible(False)
    return figure


def _doubt(resolution: Resolution) -> Figure:
    """The slice of each kind through the middle."""
    from matplotlib.figure import Figure

    doubt = resolution.doubt
    nz, ny, _ = doubt.shape
    planes = [("axial", doubt[nz // 2])] + ([("coronal", doubt[:, ny // 2])] if nz > 1 else [])
    top = max(float(np.quantile(doubt, _SATURATED)), 1e-12)
    figure = Figure(figsize=(7.4, 3.2), layout="constrained")
    axes: Any = np.atleast_1d(figure.subplots(1, len(planes)))
    for axis, (name, plane) in zip(axes, planes):
        shown = axis.imshow(plane, cmap="cividis", vmin=0.0, vmax=top, origin="lower", aspect="equal")
        axis.set_title(name, fontsize=9)
        axis.set_axis_off()
    figure.colorbar(shown, ax=list(axes), shrink=0.9, label=f"1/{resolution.unit}")
    return figure

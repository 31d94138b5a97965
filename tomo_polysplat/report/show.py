"""Results in a notebook: sliders beside linked slices, and a small picture where a result is the last line."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from tomo_polysplat.checks import require_shape
from tomo_polysplat.report.linked import LinkedSlices
from tomo_polysplat.report.page import data_uri, rows, text
from tomo_polysplat.report.slices import display_window, planes_through
from tomo_polysplat.report.style import OURS, full_name
from tomo_polysplat.result.data import ResultData

__all__ = ["show", "snippet"]

# Pixels of the small picture's longest edge.
_THUMBNAIL = 220


def show(
    result: ResultData,
    others: Mapping[str, Any] | ResultData | np.ndarray | None,
    window: tuple[float, float] | None,
) -> Any:
    """See :meth:`tomo_polysplat.result.result.Result.show`."""
    widgets = _widgets()
    volumes = _volumes(result, others)
    first = next(iter(volumes.values()))
    slices = {False: LinkedSlices(volumes, result.grid.voxel_size, result.unit)}
    begin = window or display_window(first)
    top = float(max(max(float(v.max()) for v in volumes.values()), begin[1]))
    point = [plane.index for plane in planes_through(first)] if first.shape[0] > 1 else [0, 0, 0]
    sliders = [
        widgets.IntSlider(value=at, max=n - 1, description=name, continuous_update=True)
        for name, at, n in zip("zyx", point, first.shape)
    ]
    grey = widgets.FloatRangeSlider(
        value=begin,
        min=min(0.0, begin[0]),
        max=top,
        step=top / 500,
        description="window",
        readout_format=".3g",
    )
    difference = widgets.Checkbox(value=False, description="difference", disabled=len(volumes) < 2)
    picture = widgets.Image(format="png")

    def redraw(_: Any = None) -> None:
        wanted = bool(difference.value)
        if wanted not in slices:
            slices[wanted] = LinkedSlices(volumes, result.grid.voxel_size, result.unit, difference=wanted)
        picture.value = slices[wanted].draw([slider.value for slider in sliders], tuple(grey.value))

    for control in (*sliders, grey, difference):
        control.observe(redraw, names="value")
    redraw()
    shown = sliders if first.shape[0] > 1 else []
    return widgets.VBox([widgets.HBox([*shown]), widgets.HBox([grey, difference]), picture])


def _widgets() -> Any:
    try:
        import ipywidgets
    except ImportError:
        remedy = 'ipywidgets: pip install "tomo-polysplat[notebook]"; or use result.report("page.html")'
        raise ImportError(f"result.show: needs {remedy}") from None
    return ipywidgets


def _volumes(result: ResultData, others: Any) -> dict[str, np.ndarray]:
    """Volumes (z, y, x) by name, ours first."""
    if others is None:
        others = {}
    elif not isinstance(others, Mapping):
        others = {"other": others}
    volumes = {full_name(OURS): result.volume}
    for name, other in others.items():
        values = np.asarray(other.volume if isinstance(other, ResultData) else other, np.float32)
        require_shape(name, values, result.volume.shape, "of the result's volume")
        volumes[str(name)] = values
    return {name: v[None, ::-1] if v.ndim == 2 else v for name, v in volumes.items()}


def snippet(result: ResultData) -> str:
    """A slice through the middle and the main numbers, as a piece of HTML."""
    nz, ny, nx = result.grid.shape
    energy = "unknown" if result.energy_kev is None else f"{result.energy_kev:.1f} keV"
    size = " x ".join(f"{edge:.4g}" for edge in result.grid.voxel_size)
    facts = {
        "attenuation": f"1/{result.unit} at {energy}" if result.energy_kev else f"1/{result.unit}",
        "voxels": f"{nx} x {ny} x {nz} of {size} {result.unit} (x, y, z)",
        "model": "one energy" if result.materials is None else "polychromatic",
        "Gaussians": str(len(result.gaussians.get("density", ()))),
        "seconds": f"{result.seconds:.1f}",
    }
    picture = f'<img alt="middle slice" src="{data_uri(_thumbnail(result))}">'
    head = f"<b>{text(result.provenance.get('scan', 'tomo-polysplat result'))}</b>"
    layout = "display: flex; gap: 1rem; align-items: flex-start"
    return f'<div style="{layout}">{picture}<div>{head}{rows(facts)}</div></div>'


def _thumbnail(result: ResultData) -> bytes:
    """PNG of the middle slice; of that alone, for the whole volume may take a while."""
    import io

    from PIL import Image

    middle = result.basis[:, result.grid.shape[0] // 2]
    if result.materials is not None:
        curves = result.materials.mass_attenuation([result.energy_kev])[:, 0]
        middle = np.tensordot(curves, middle, axes=1)[None]
    low, high = display_window(middle)
    grey = np.clip((np.nan_to_num(middle[0, ::-1]) - low) / (high - low), 0, 1)
    picture = Image.fromarray((255 * grey + 0.5).astype(np.uint8))
    times = _THUMBNAIL / max(picture.size)
    scaled = picture.resize([max(1, round(n * times)) for n in picture.size], Image.Resampling.NEAREST)
    buffer = io.BytesIO()
    scaled.save(buffer, format="PNG")
    return buffer.getvalue()

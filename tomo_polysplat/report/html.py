"""The page about a reconstruction that a scientist sends to a colleague: one file, nothing loaded from elsewhere."""

from __future__ import annotations

import logging
import os
from typing import TYPE_CHECKING

import numpy as np

from tomo_polysplat.checks import require_shape
from tomo_polysplat.files import write_text
from tomo_polysplat.report import table as tables
from tomo_polysplat.report.browse import browser
from tomo_polysplat.report.classical import standard_volume
from tomo_polysplat.report.decided import decisions, in_words, rest_of_plan
from tomo_polysplat.report.detail import detail
from tomo_polysplat.report.evidence import by_pixel_figure, by_view_figure
from tomo_polysplat.report.figures import history_figure, png_bytes, slices_figure
from tomo_polysplat.report.materials import histogram_figure
from tomo_polysplat.report.page import folded, image, page, section, text
from tomo_polysplat.report.residuals import residuals_of
from tomo_polysplat.report.slices import Plane, display_window, planes_through
from tomo_polysplat.report.style import OURS, full_name
from tomo_polysplat.report.verdict import verdict
from tomo_polysplat.result.residuals import Residuals

if TYPE_CHECKING:
    from tomo_polysplat.result.data import ResultData
    from tomo_polysplat.result.detail import Contrast, Resolution
    from tomo_polysplat.scan.scan import Scan

__all__ = ["image", "of_scan", "page", "title_of", "told", "write_report"]

logger = logging.getLogger(__name__)

Volumes = list[tuple[str, np.ndarray]]


# One parameter for each option that a caller names.
def write_report(
    result: ResultData,
    path: str | os.PathLike,
    *,
    scan: Scan | None = None,
    truth: np.ndarray | None = None,
    metal_mask: np.ndarray | None = None,
    found: tuple[Resolution | None, Contrast | None] = (None, None),
    overwrite: bool = False,
) -> None:
    """Write the page; see :meth:`tomo_polysplat.result.result.Result.report`."""
    volume = _spatial(result, result.volume)
    true = None if truth is None else _spatial(result, truth)
    metal = None if metal_mask is None else _spatial(result, metal_mask).astype(bool)
    residuals, beside = (result.residuals, []) if scan is None else of_scan(result, scan)
    shown = beside + [(full_name(OURS), volume), *([] if true is None else [("truth", true)])]
    title = title_of(result, scan)
    body = [
        f"<h1>{text(title)}</h1>",
        f'<p class="note">{text(_about(result))}</p>',
        *_verdict(result, residuals),
        *_slices(result, shown, true, metal),
        *_errors(result, volume, true, metal),
        *_rays(residuals),
        *detail(*found),
        "<h2>What the voxels hold</h2>",
        image(png_bytes(histogram_figure(result)), "histogram of the attenuation with the materials named"),
        *_speed(result),
        *_decided(result),
        *_folded(result),
    ]
    write_text(path, page(f"{title} – tomo-polysplat", body), overwrite=overwrite)


def told(result: ResultData, residuals: Residuals | None) -> list[str]:
    """Pieces of HTML on how well the rays are explained and what was decided, without slices and for another page."""
    return [
        f'<p class="note">{text(_about(result))}</p>',
        *_verdict(result, residuals),
        *_rays(residuals),
        *_speed(result),
        *_decided(result),
    ]


def _verdict(result: ResultData, residuals: Residuals | None) -> list[str]:
    sentences = "".join(f"<p>{text(words)}</p>" for words in verdict(result, residuals))
    return [f'<div class="verdict">{sentences}</div>']


def _speed(result: ResultData) -> list[str]:
    figure = history_figure(result.history)
    return [
        "<h2>Speed against error</h2>",
        image(png_bytes(figure), "error of the projections against seconds"),
    ]


def title_of(result: ResultData, scan: Scan | None) -> str:
    """The scan's name, where somebody has told it."""
    told = result.provenance.get("scan") or ("" if scan is None else scan.name)
    return str(told or "Reconstruction")


def _about(result: ResultData) -> str:
    nz, ny, nx = result.grid.shape
    size = " x ".join(f"{edge:.4g}" for edge in result.grid.voxel_size)
    energy = "" if result.energy_kev is None else f" at {result.energy_kev:.1f} keV"
    number = len(result.gaussians.get("density", ()))
    return (
        f"Attenuation in 1/{result.unit}{energy}; {nx} x {ny} x {nz} voxels of {size} {result.unit} (x, y, z); "
        f"{number} Gaussians, {result.seconds:.1f} s"
    )


def of_scan(result: ResultData, scan: Scan) -> tuple[Residuals | None, Volumes]:
    """Residuals, and the volume of the standard method by its name; what fails is left out, which the log says.

    Residuals that the result has already are taken, others are kept in it.
    """
    residuals, beside = result.residuals, []
    try:
        name, volume = standard_volume(scan)
        require_shape("the scan's volume", volume, result.grid.shape, "of the result")
        beside.append((full_name(name.lower()) if name == "FDK" else name, volume))
        if residuals is None and result.gaussians:
            residuals = result.residuals = residuals_of(result, scan)
    except (ValueError, RuntimeError, MemoryError) as error:
        logger.warning("The page does without what the scan would tell: %s", error)
    return residuals, beside


def _spatial(result: ResultData, volume: np.ndarray) -> np.ndarray:
    """As (z, y, x) with y ascending, whatever order the caller's geometry has."""
    volume = np.asarray(volume)
    require_shape("truth, metal_mask", volume, result.volume.shape, "of the volume")
    return volume[None, ::-1] if result.flipped_2d else volume


def _slices(
    result: ResultData, shown: Volumes, truth: np.ndarray | None, metal: np.ndarray | None
) -> list[str]:
    """The browser of axial slices, and the other two planes below it."""
    ours = dict(shown)[full_name(OURS)]
    window = display_window(ours if truth is None else truth, metal)
    axial, *others = planes_through(ours if metal is None else metal)
    parts = [browser(shown, window, axial.index, result.grid.axes()[2], result.unit)]
    return parts + (_other_planes(result, shown, window, others) if others else [])


def _other_planes(
    result: ResultData, shown: Volumes, window: tuple[float, float], planes: list[Plane]
) -> list[str]:
    figure = slices_figure(shown, result.unit, result.energy_kev, window, planes)
    return ["<h2>The other two planes</h2>", image(png_bytes(figure), "coronal and sagittal slices")]


def _errors(
    result: ResultData, volume: np.ndarray, truth: np.ndarray | None, metal: np.ndarray | None
) -> list[str]:
    if truth is None:
        return []
    from tomo_polysplat.result.metrics import compare

    try:
        entry = {"name": OURS, "seconds": result.seconds, **compare(volume, truth, metal)}
    except ValueError as error:  # of a volume two voxels high, say, which the page still shows
        logger.warning("Not compared with the truth: %s", error)
        return section("Against the truth", {"not compared": str(error)})
    return section("Against the truth", dict(zip(tables.headings(result.unit)[1:], tables.cells(entry)[1:])))


def _rays(residuals: Residuals | None) -> list[str]:
    if residuals is None:
        return []
    note = (
        f"Residuals of {residuals.rays} rays of {len(residuals.views)} views, in {residuals.unit}. "
        "A view that stands out has moved or was disturbed; a pixel that stands out has a gain of its own."
    )
    return [
        "<h2>How well the rays are explained</h2>",
        f'<p class="note">{text(note)}</p>',
        image(png_bytes(by_view_figure(residuals)), "rms residual by view"),
        image(png_bytes(by_pixel_figure(residuals)), "rms and mean residual by pixel of the detector"),
    ]


def _decided(result: ResultData) -> list[str]:
    """The decisions that mattered, each with its evidence."""
    told = []
    for subject, one in decisions(result.plan):
        status = f'<span class="status">{text(one.status.value)}</span>'
        words = in_words(one)
        told.append(f"<dt>{text(subject)}{status}</dt><dd>{text(words[:1].upper() + words[1:])}.</dd>")
    return ["<h2>What was decided, and why</h2>", f"<dl>{''.join(told)}</dl>"] if told else []


def _folded(result: ResultData) -> list[str]:
    parts = [
        *folded("The rest of the plan", rest_of_plan(result.plan)),
        *folded("Left out or limited: counts", result.counts),
        *folded("Settings", result.settings),
        *folded("Made from and with", result.provenance),
    ]
    return ["<h2>For the record</h2>", *parts] if parts else []

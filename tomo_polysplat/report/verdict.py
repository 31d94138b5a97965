"""Three sentences for a reader in a hurry: are the rays explained, what was found, what is to be distrusted."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from tomo_polysplat.report.decided import (
    doubts,
    found_about_the_scanner,
    how_it_ended,
    how_rays_are_missed,
)

if TYPE_CHECKING:
    from tomo_polysplat.result.data import ResultData
    from tomo_polysplat.result.residuals import Residuals

__all__ = ["distrusted", "explained", "verdict"]

# So many times the usual residual is worth a warning: of a view, of a pixel, of the rays through a place.
_ODD_VIEW, _ODD_PIXEL, _ODD_PLACE = 1.5, 2.0, 2.0
# A larger share of rays without light, left out, or of pixels that stand out is told.
_LIGHTLESS, _LEFT_OUT, _PIXELS = 1e-4, 0.02, 0.002
# A larger share of the volume that no ray sees is told.
_UNSEEN = 0.005
# Pixels of a row that a pixel is compared with.
_BESIDE = 9
# Times its noise that a scan is explained to at best, for its pixels to be told.
_FAR_OFF = 5.0
# Share of rays within three deviations that normal noise alone would leave.
_NORMAL = 0.9973


def verdict(result: ResultData, residuals: Residuals | None) -> list[str]:
    """The three sentences."""
    return [explained(result, residuals), found_about_the_scanner(result.plan), distrusted(result, residuals)]


def explained(result: ResultData, residuals: Residuals | None) -> str:
    """How well the model explains the rays, in units of their noise where the scan is at hand."""
    if residuals is not None:
        if not residuals.noisy:
            return f"The data shows no noise; the model misses the rays by {residuals.rms:.2g} of -log(I/I0)."
        unseen = residuals.rms_held_out
        apart = f" (those kept out of the fit to {_short(unseen)})" if np.isfinite(unseen) else ""
        return (
            f"The model explains the rays to {_short(residuals.rms)} times their noise{apart}: "
            f"{residuals.within:.1%} of {residuals.rays:,} rays lie within three deviations, where noise alone would "
            f"leave {_NORMAL:.1%}."
        )
    if told := how_rays_are_missed(result.plan):
        return told
    known = [entry for entry in result.history if entry.get("held_out") is not None]
    if not known:
        return "How well the rays are explained was not recorded; give the report the scan to find out."
    return (
        f"Rays kept out of the fit are met within {known[-1]['held_out']:.2g} of -log(I/I0); give the report the "
        "scan to see that in units of their noise."
    )


def distrusted(result: ResultData, residuals: Residuals | None) -> str:
    """What to distrust, and where."""
    found = doubts(result.plan)
    found += [] if residuals is None else _doubts_of_residuals(result, residuals)
    found += _doubts_of_counts(result)
    if "unseen" in result.plan and float(result.plan["unseen"].value) > _UNSEEN:
        share = float(result.plan["unseen"].value)
        found.append(f"{share:.1%} of the volume, which no ray sees (Result.coverage tells where)")
    ended = how_it_ended(result.plan)
    if "interrupted" in ended or "time budget" in ended:
        found.append(f"all fine detail, for the run was cut short ({ended})")
    if not found:
        return (
            "Nothing stands out that ought to be distrusted."
            if residuals
            else "Of the rays, nothing was found."
        )
    return f"Distrust {'; '.join(found)}."


def _doubts_of_residuals(result: ResultData, residuals: Residuals) -> list[str]:
    doubts = []
    usual = residuals.usual_value
    if usual > 0 and residuals.worst_value > _ODD_PLACE * usual and residuals.worst_value > 2.0:
        x, y, z = residuals.worst
        doubts.append(
            f"what lies around x, y, z = {x:.3g}, {y:.3g}, {z:.3g} {result.unit}, where rays meet that miss by "
            f"{_short(residuals.worst_value)} {residuals.unit} ({_short(usual)} elsewhere)"
        )
    middle = np.nanmedian(residuals.by_view) if np.isfinite(residuals.by_view).any() else 0.0
    odd = residuals.views[residuals.by_view > _ODD_VIEW * middle] if middle else residuals.views[:0]
    if len(odd):
        times = float(np.nanmax(residuals.by_view) / middle)
        doubts.append(f"{_views(odd)}, explained up to {times:.2g} times worse than the others")
    share, where = _odd_pixels(residuals)
    # Where the model itself is far off, what it lacks looks like that, too.
    if share > _PIXELS and residuals.rms < _FAR_OFF:
        doubts.append(
            f"{share:.1%} of the detector, mostly {where}, whose pixels are off by the same amount in every view"
        )
    return doubts


def _odd_pixels(residuals: Residuals) -> tuple[float, str]:
    """Share of pixels whose mean residual stands out of their neighbours' in the row, and where most of them are."""
    from scipy.ndimage import median_filter

    known = np.isfinite(residuals.bias)
    if not known.any():
        return 0.0, ""
    # Matter that is not explained moves along the rows with the views, and leaves bands; a pixel's own error stays.
    alone = np.where(
        known, residuals.bias - median_filter(np.where(known, residuals.bias, 0.0), (1, _BESIDE)), 0.0
    )
    spread = 1.4826 * float(np.median(np.abs(alone[known])))
    # The same in every view: by far more than it varies from view to view.
    varies = np.sqrt(np.maximum(residuals.by_pixel**2 - residuals.bias**2, 0.0))
    odd = known & (np.abs(alone) > np.maximum(_ODD_PIXEL * varies, 6 * spread))
    rows, columns = np.nonzero(odd)
    if not len(rows):
        return 0.0, ""
    ends = [np.quantile(index, share) * residuals.block for index in (rows, columns) for share in (0.1, 0.9)]
    first, last, left, right = (int(end) for end in ends)
    return len(rows) / int(known.sum()), f"rows {first} to {last}, columns {left} to {right}"


def _views(odd: np.ndarray) -> str:
    if len(odd) == 1:
        return f"view {odd[0]}"
    return (
        f"views {', '.join(map(str, odd))}"
        if len(odd) <= 4
        else f"{len(odd)} views from {odd[0]} to {odd[-1]}"
    )


def _doubts_of_counts(result: ResultData) -> list[str]:
    counts = result.counts
    doubts: list[str] = []
    rays = counts.get("rays") or 0
    if not rays:
        return doubts
    if (opaque := counts.get("rays_opaque", 0) / rays) > _LIGHTLESS:
        doubts.append(f"the inside of matter that lets no light through ({opaque:.2%} of the rays)")
    names = ("rays_not_finite", "rays_out_of_range", "rays_of_stuck_pixels", "rays_of_columns_apart")
    if (lost := sum(counts.get(name, 0) for name in names) / rays) > _LEFT_OUT:
        doubts.append(f"the shadow of the rays left out ({lost:.1%}; the counts below say why)")
    return doubts


def _short(number: float) -> str:
    """Two digits, and no powers of ten."""
    return f"{number:.2g}" if number < 99.5 else f"{number:.0f}"

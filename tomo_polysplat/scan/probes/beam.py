"""Does the open beam belong to the projections?"""

from __future__ import annotations

from typing import Any

import numpy as np

from tomo_polysplat.scan.probes.air import Air
from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured

__all__ = ["BEAM", "probe_beam"]

BEAM = "open beam"
# What -log(I/I0) may be off by beside the object; what a source may change by.
_TOLERATED, _FLICKER = 0.02, 0.02
_SURE = 4.0
# Share of frames' light that they may differ by, and of the rays beside the object that hold the same value.
_FRAMES, _SAME = 0.05, 0.3
# Share of the rays that may be saturated.
_SATURATED = 0.01
# Rays that tell whether there is noise: 1.4 of noise is new in the next view.
_FEWEST, _NEW = 50, 0.8
# Largest numbers of cameras with 8 to 16 bits.
_LIMITS = 2.0 ** np.array([8, 10, 12, 14, 16]) - 1


def probe_beam(measured: Measured) -> Finding:
    """Question flats, darks and the source: by the file's frames, and by the rays beside the object."""
    told = _frames(measured.scan.notes) or _saturated(measured)
    if told:
        return Finding(BEAM, DEFECT, *told)
    air = measured.air
    if air is None:
        text = "no rays beside the object tell whether the flats belong to the projections"
        return Finding(BEAM, UNKNOWN, text, "a view of air beside the object")
    numbers = {"level": air.level, "same": air.share}
    if abs(air.level) > _TOLERATED + _SURE * air.error:
        factor = np.exp(-air.level)
        text = f"beside the object -log(I/I0) is {air.level:+.3f} instead of 0: {factor:.3g} times the flats' light"
        remedy = "take flats at the projections' exposure, or subtract what the rays beside the object hold"
        return Finding(BEAM, DEFECT, text, remedy, numbers, air.error)
    drift, error = _common_change(air)
    numbers["change"] = drift
    if drift > _FLICKER + _SURE * error:
        text = f"the light beside the object changes by {100 * drift:.2g} % in the course of the scan"
        remedy = "normalise each view by the rays beside the object"
        return Finding(BEAM, DEFECT, text, remedy, numbers, error)
    if _SURE * max(error, air.error) > max(_TOLERATED, _FLICKER):
        return Finding(
            BEAM, UNKNOWN, "the rays beside the object are too few or noisy", "more light", numbers, error
        )
    share = 100 * -np.expm1(-abs(air.level))
    side = "less" if air.level > 0 else "more"
    right = f"up to {100 * _TOLERATED:g} % is right"
    text = f"beside the object there is {share:.2g} % {side} light than in the flats ({right})"
    return Finding(BEAM, OK, text, "", numbers, air.error)


def _frames(notes: dict[str, Any]) -> tuple[str, str] | None:
    """What the frames of the flat and dark fields say, where they were read."""
    white, dark = (np.asarray(notes.get(f"{name}_frames", ()), np.float64) for name in ("white", "dark"))
    if not len(white):
        return None
    light = float(np.median(white))
    if len(dark) > 1 and np.ptp(dark) > _FRAMES * light:
        number = int(np.sum(dark > dark.min() + _FRAMES * light))
        return f"the beam was on in {number} of {len(dark)} dark images", "leave these dark images out"
    level = float(dark.mean()) if len(dark) else 0.0
    closed = int(np.sum(white - level < 0.1 * (white.max() - level)))
    if closed:
        return (
            f"the shutter was closed in {closed} of {len(white)} flat images",
            "leave these flat images out",
        )
    change = float(np.ptp(white) / max(white.max() - level, 1e-12))
    if change > _FRAMES:
        text = f"the light of the flat images changes by {100 * change:.2g} %: the source falls or flickers"
        return text, "interpolate the flats in time, or normalise each view by the rays beside the object"
    return None


def _saturated(measured: Measured) -> tuple[str, str] | None:
    """Whether the open beam is at the limit of the camera's scale."""
    remedy = "measure with less light or a shorter exposure; saturation= leaves such rays out"
    saturated = measured.scan.notes.get("rays", {}).get("saturated", 0) / measured.scan.projections.size
    if saturated > _SATURATED:
        return f"{100 * saturated:.2g} % of the rays are saturated, beside the object above all", remedy
    air = measured.air
    if air is None or air.share < _SAME:
        return None
    # Air without noise is the same everywhere.
    white = np.asarray(measured.scan.notes.get("white_frames", ()), np.float64)
    at_limit = len(white) > 0 and bool(np.isin(white, _LIMITS).all())
    if not (at_limit or _noisy(measured)):
        return None
    text = f"{100 * air.share:.0f} % of the rays beside the object hold the very same value: saturated"
    return text, remedy


def _noisy(measured: Measured) -> bool:
    """Whether rays through the object differ from the mean of their neighbours to both sides by chance."""
    values = measured.filled.astype(np.float64)
    bend = values[..., 1:-1] - 0.5 * (values[..., :-2] + values[..., 2:])
    some = values[..., 1:-1] > 0.2 * measured.level
    both = some[:, 1:] & some[:, :-1]
    if np.count_nonzero(both) < _FEWEST:
        return False
    # Detail of the object comes again in the next view, noise does not.
    change = float(np.median(np.abs(np.diff(bend, axis=1)[both])))
    return change > _NEW * float(np.median(np.abs(bend[:, 1:][both])))


def _common_change(air: Air) -> tuple[float, float]:
    """By how much both ends of the detector change together from view to view, and the standard error of one view."""
    first, last = air.by_view - air.by_view.mean(axis=1, keepdims=True)
    together = float(np.mean(first * last))
    error = float(np.std(first - last) / 2)
    return float(np.sqrt(max(together, 0.0))), error / np.sqrt(len(first)) + error * len(first) ** -0.25

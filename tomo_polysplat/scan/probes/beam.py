"""Does the open beam belong to the projections?"""

from __future__ import annotations

from typing import Any

import numpy as np

from tomo_polysplat.scan.light_end import lower_end
from tomo_polysplat.scan.probes.air import Air
from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured

__all__ = ["BEAM", "SATURATED_SHARE", "TOO_DIM", "beside_the_object", "is_off", "probe_beam"]

BEAM = "open beam"
# What -log(I/I0) may be off by beside the object; what a source may change by.
_TOLERATED, _FLICKER = 0.02, 0.02
_SURE = 4.0
# Share of frames' light that they may differ by, and of the rays beside the object that hold the same value.
_FRAMES, SATURATED_SHARE = 0.05, 0.3
TOO_DIM = "take flats at the projections' exposure, or subtract what the rays beside the object hold"
# Share of the rays that may be saturated.
_SATURATED = 0.01
# Rays that tell whether there is noise: 1.4 of noise is new in the next view, and in the next row.
_FEWEST, _NEW = 50, 0.8
_LESS_LIGHT = "measure with less light or a shorter exposure"
# Largest numbers of cameras with 8 to 16 bits.
_LIMITS = 2.0 ** np.array([8, 10, 12, 14, 16]) - 1


def probe_beam(measured: Measured) -> Finding:
    """Question flats, darks and the source: by the file's frames, and by the rays beside the object."""
    told = _frames(measured.scan.notes) or _marked(measured)
    if told:
        return Finding(BEAM, DEFECT, *told)
    end = lower_end(measured.filled.swapaxes(0, 1))
    if end is not None:
        text = f"many rays beside the object hold the very same value, {end:.3g}, the least of all: saturated"
        return Finding(
            BEAM, DEFECT, text, f"{_LESS_LIGHT}; a run takes them to pass beside the object", {"end": end}
        )
    air = measured.air
    if air is None:
        text = "no rays beside the object tell whether the flats belong to the projections"
        return Finding(BEAM, UNKNOWN, text, "a view of air beside the object")
    numbers = {"level": air.level, "same": air.share}
    if air.share >= SATURATED_SHARE:
        return _saturated(measured, numbers)
    if is_off(air):
        text = beside_the_object(air)
        remedy = f"{TOO_DIM}, as a run does here" if air.sure else TOO_DIM
        return Finding(BEAM, DEFECT, text, remedy, numbers | {"off": air.level}, air.error)
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
    mended = "; a run takes it out" if air.sure else ""
    text = f"beside the object there is {share:.2g} % {side} light than in the flats ({right}{mended})"
    return Finding(BEAM, OK, text, "", numbers, air.error)


def is_off(air: Air) -> bool:
    """Whether the level of air is farther from 0 than is tolerated."""
    return abs(air.level) > _TOLERATED + _SURE * air.error


def beside_the_object(air: Air) -> str:
    """What rays hold there, in words."""
    factor = np.exp(-air.level)
    return (
        f"beside the object -log(I/I0) is {air.level:+.3f} instead of 0: {factor:.3g} times the flats' light"
    )


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


def _marked(measured: Measured) -> tuple[str, str] | None:
    """Whether the reader has marked many rays as saturated."""
    saturated = measured.scan.notes.get("rays", {}).get("saturated", 0) / measured.scan.projections.size
    if saturated > _SATURATED:
        return f"{100 * saturated:.2g} % of the rays are saturated, beside the object above all", _LESS_LIGHT
    return None


def _saturated(measured: Measured, numbers: dict[str, float]) -> Finding:
    """What many rays beside the object with the very same value mean: the end of the scale, or no noise at all."""
    same = f"{100 * numbers['same']:.0f} % of the rays beside the object hold the very same value"
    white = np.asarray(measured.scan.notes.get("white_frames", ()), np.float64)
    at_limit = len(white) > 0 and bool(np.isin(white, _LIMITS).all())
    if at_limit or _noisy(measured):
        return Finding(BEAM, DEFECT, f"{same}: saturated", _LESS_LIGHT, numbers)
    text = f"{same}: the detector is saturated, or the pictures have no noise"
    return Finding(BEAM, UNKNOWN, text, "a look at the brightest pixels of the raw pictures", numbers)


def _noisy(measured: Measured) -> bool:
    """Whether rays through the object differ from the mean of their neighbours by chance: anew in each view and row.

    Detail of the object goes on in the next row, and in the next view where that is less than a pixel away.
    """
    values = measured.filled.astype(np.float64)
    bend = values[..., 1:-1] - 0.5 * (values[..., :-2] + values[..., 2:])
    some = values[..., 1:-1] > 0.2 * measured.level
    if len(values) == 1 and _step(measured) > 1:
        return False
    return all(_new(bend, some, axis) for axis in ((0, 1) if len(values) > 1 else (1,)))


def _step(measured: Measured) -> float:
    """By how many pixels points half-way to the volume's border move from a view to the next one."""
    places = measured.places
    return float(np.median(np.linalg.norm(np.diff(places, axis=0), axis=1)))


def _new(bend: np.ndarray, some: np.ndarray, axis: int) -> bool:
    """Whether the bends of some rays are others in the next view or row."""
    bend, some = np.moveaxis(bend, axis, 0), np.moveaxis(some, axis, 0)
    both = some[1:] & some[:-1]
    if np.count_nonzero(both) < _FEWEST:
        return False
    change = float(np.median(np.abs(np.diff(bend, axis=0)[both])))
    return change > _NEW * float(np.median(np.abs(bend[1:][both])))


def _common_change(air: Air) -> tuple[float, float]:
    """By how much both ends of the detector change together from view to view, and the standard error of one view."""
    first, last = air.by_view - air.by_view.mean(axis=1, keepdims=True)
    together = float(np.mean(first * last))
    error = float(np.std(first - last) / 2)
    return float(np.sqrt(max(together, 0.0))), error / np.sqrt(len(first)) + error * len(first) ** -0.25

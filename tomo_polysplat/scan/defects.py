"""Convert counts to line integrals, and count the rays that were not measured properly."""

from __future__ import annotations

import logging
import math

import numpy as np

from tomo_polysplat.checks import fail, require_shape
from tomo_polysplat.parallel import cpu_threads, run_tasks, split_range
from tomo_polysplat.scan.counts_kernel import KINDS, count_kinds, line_integrals_of_counts
from tomo_polysplat.scan.frame_mean import FrameMean

__all__ = ["attenuation", "fill_invalid", "flat_and_dark", "unusable"]

logger = logging.getLogger(__name__)


def flat_and_dark(
    white: np.ndarray,
    dark: np.ndarray | None,
    shape: tuple[int, int],
    names: tuple[str, str] = ("data_white", "data_dark"),
) -> tuple[np.ndarray, np.ndarray]:
    """Mean open-beam and dark images of a detector of `shape` (rows, columns); no dark image means zero.

    `names` are what the caller knows the two as.

    Raises
    ------
    ValueError
        If a shape is not that of the detector, or the open-beam image has no more light than the dark one.
    """
    flat = _mean_frame(names[0], white, shape)
    background = np.zeros(shape) if dark is None else _mean_frame(names[1], dark, shape)
    light, without = (np.where(np.isfinite(image), image, 0).mean() for image in (flat, background))
    if not light > without:
        remedy = "are the two swapped, or was there no light?"
        raise fail(names[0], f"more light than {names[1]} has, {without:.6g} counts", f"{light:.6g}", remedy)
    return flat, background


def _mean_frame(name: str, frames: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    frames = np.asarray(frames)
    frames = frames[None] if frames.ndim == 2 else frames
    if frames.ndim != 3 or not len(frames):
        raise fail(name, "frames of shape (frames, rows, columns)", f"shape {frames.shape}")
    require_shape(name, frames[0], shape, "(rows, columns) of the data")
    images = FrameMean()
    for frame in frames:
        images.add(frame)
    return images.mean(name)


def attenuation(
    values: np.ndarray,
    kind: str,
    flat: np.ndarray | None = None,
    dark: np.ndarray | None = None,
    saturation: float | None = None,
    into: tuple[np.ndarray, np.ndarray] | None = None,
) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
    """Line integrals, and which of them are valid.

    Parameters
    ----------
    values : array, shape (views, rows, columns)
        What the file holds.
    kind : {"counts", "transmission", "attenuation"}
        Detector counts, I/I0, or -log(I/I0) already.
    flat, dark : array, shape (rows, columns)
        Mean open-beam and dark images; for counts only.
    saturation : float or None
        Counts from which the detector is saturated; None takes the largest value of an integer type.
    into : float32 and bool arrays, shape of `values`, optional
        Where the results go.

    Returns
    -------
    projections : float32 array, shape of `values`
        ``-log((values - dark) / (flat - dark))``. An invalid ray is infinite if no light was seen, minus infinity if
        the detector was saturated by less light than the open beam has, else 0.
    valid : bool array, shape of `values`
        False for rays without light, of dead pixels, saturated, or not finite. Nothing is clipped.
    counts : dict
        How many rays of each kind were found.
    """
    made, usable = (np.empty(values.shape, dtype) for dtype in (np.float32, bool)) if into is None else into
    if kind == "counts":
        return made, usable, _of_counts(values, flat, dark, saturation, (made, usable))
    if kind == "attenuation":
        # Values beyond float32 count as infinite.
        with np.errstate(over="ignore"):
            made[:] = values
        usable[:] = np.isfinite(made)
        made[~(usable | np.isposinf(values))] = 0.0
        return made, usable, {"not_finite": int(values.size - np.count_nonzero(usable))}
    finite = np.isfinite(values)
    dim = finite & ~(values > 0)
    usable[:] = finite & ~dim
    made[:] = -np.log(np.where(usable, values, 1))
    made[dim] = np.inf
    counts = {
        "not_finite": int(values.size - np.count_nonzero(finite)),
        "no_light": int(np.count_nonzero(dim)),
    }
    return made, usable, counts


def unusable(
    values: np.ndarray,
    kind: str,
    flat: np.ndarray | None = None,
    dark: np.ndarray | None = None,
    saturation: float | None = None,
) -> dict[str, int]:
    """The counts that `attenuation` gives of the same parameters; of detector counts without a logarithm."""
    if kind == "counts":
        return _of_counts(values, flat, dark, saturation)
    return attenuation(values, kind)[2]


def _of_counts(
    values: np.ndarray,
    flat: np.ndarray | None,
    dark: np.ndarray | None,
    saturation: float | None,
    into: tuple[np.ndarray, np.ndarray] | None = None,
) -> dict[str, int]:
    """How many rays of each kind there are; line integrals, and which are valid, go into two arrays, if any."""
    if flat is None or dark is None:
        raise fail("flat, dark", "open-beam and dark images", "None", "counts cannot be used without them")
    limit = np.iinfo(values.dtype).max if saturation is None and values.dtype.kind in "iu" else saturation
    # Two types are compiled: that of most cameras, and one that holds the numbers of all others.
    one = np.dtype(np.uint16 if values.dtype == np.uint16 else np.float64)
    flat, dark = (np.ascontiguousarray(image, np.float64) for image in (flat, dark))
    found, end = np.zeros(len(KINDS), np.int64), math.inf if limit is None else float(limit)
    for number, view in enumerate(values):
        given = np.ascontiguousarray(view, one), flat, dark, end
        if into is None:
            count_kinds(*given, found)
        else:
            line_integrals_of_counts(*given, into[0][number], into[1][number], found)
    counts = {name: int(number) for name, number in zip(KINDS, found)}
    return {name: number for name, number in counts.items() if name != "saturated" or limit is not None}


def fill_invalid(projections: np.ndarray, valid: np.ndarray | None) -> np.ndarray:
    """Projections with every invalid ray replaced, linearly between the valid ones of its detector row.

    It is for methods that cannot leave a ray out, such as filtered backprojection. The last axis is the detector
    column. Beyond the outermost valid ray a row is constant; rows without a valid ray become 0.

    Parameters
    ----------
    projections : float array, shape (..., columns)
    valid : bool array of that shape, or None
        None means that all are.

    Returns
    -------
    float array, shape of `projections`
        The input itself when there is nothing to replace, else a copy, float64 unless the input is float32.
    """
    if valid is None or valid.all():
        return projections
    from tomo_polysplat.scan.filling import fill_rows_in_place

    columns = projections.shape[-1]
    filled = np.array(projections, np.float32 if projections.dtype == np.float32 else np.float64, order="C")
    rows, usable = filled.reshape(-1, columns), np.ascontiguousarray(valid, bool).reshape(-1, columns)
    parts = split_range(len(rows), 4 * cpu_threads())
    run_tasks(fill_rows_in_place, [(rows[a:b], usable[a:b]) for a, b in parts])
    return filled

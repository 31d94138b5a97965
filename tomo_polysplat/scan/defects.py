"""Convert counts to line integrals, and count the rays that were not measured properly."""

from __future__ import annotations

import logging

import numpy as np

from tomo_polysplat.checks import fail, require_shape
from tomo_polysplat.parallel import cpu_threads, run_tasks, split_range

__all__ = ["attenuation", "fill_invalid", "flat_and_dark"]

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
    return frames.mean(axis=0, dtype=np.float64)


def attenuation(
    values: np.ndarray,
    kind: str,
    flat: np.ndarray | None = None,
    dark: np.ndarray | None = None,
    saturation: float | None = None,
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
    usable = np.isfinite(values)
    bright = None
    counts = {"not_finite": int(values.size - np.count_nonzero(usable))}
    if kind == "attenuation":
        # Values beyond float32 count as infinite.
        with np.errstate(over="ignore"):
            narrow = np.where(usable, values, 0).astype(np.float32)
        usable &= np.isfinite(narrow)
        counts = {"not_finite": int(values.size - np.count_nonzero(usable))}
        narrow[~usable] = 0.0
        narrow[np.isposinf(values)] = np.inf
        return narrow, usable, counts
    if kind == "counts":
        if flat is None or dark is None:
            raise fail(
                "flat, dark", "open-beam and dark images", "None", "counts cannot be used without them"
            )
        limit = np.iinfo(values.dtype).max if saturation is None and values.dtype.kind in "iu" else saturation
        if limit is not None:
            counts["saturated"] = _drop(usable, values >= limit)
            if counts["saturated"] and (flat > limit).any():
                bright = (values >= limit) & (flat > limit)
        light = flat - dark
        counts["dead_pixel"] = _drop(
            usable, np.broadcast_to(~(np.isfinite(light) & (light > 0)), values.shape)
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            values = (values - dark) / light
    dim = usable & ~(values > 0)
    counts["no_light"] = _drop(usable, dim)
    projections = -np.log(np.where(usable, values, 1)).astype(np.float32)
    projections[dim] = np.inf
    if bright is not None:
        projections[bright] = -np.inf
    return projections, usable, counts


def _drop(usable: np.ndarray, bad: np.ndarray) -> int:
    """Mark the bad ones among the usable as unusable, and say how many that were."""
    newly = usable & bad
    usable &= ~bad
    return int(np.count_nonzero(newly))


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

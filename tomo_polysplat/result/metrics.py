"""How far a volume is from the truth.

Metal is left out of the figures that judge the rest of the object, because a single voxel of metal is
brighter than everything else and would set both the error and the range it is compared with.
"""

from __future__ import annotations

import math

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_shape
from tomo_polysplat.parallel import run_tasks, split_range

__all__ = ["compare", "psnr", "ssim"]

# Parts of a volume whose similarity is looked at side by side; their number is part of the result.
_SLABS = 8


def compare(volume: np.ndarray, truth: np.ndarray, metal_mask: np.ndarray | None = None) -> dict[str, float]:
    """Errors of a reconstructed volume.

    Parameters
    ----------
    volume, truth : array, shape (z, y, x) or (y, x)
        Attenuation at the same energy and in the same unit (1/length).
    metal_mask : bool array of that shape, or None
        Voxels of metal; None means that there are none.

    Returns
    -------
    dict
        ``psnr`` (dB, voxels without metal, range = largest truth value without metal), ``psnr_all`` (dB,
        every voxel, range = largest truth value), ``ssim`` (metal set to zero in both, range as for
        ``psnr``; three-dimensional unless there is one slice) and ``rmse`` (1/length, without metal).

    Raises
    ------
    ValueError
        If shapes differ, a value is not finite, or no voxel is free of metal.
    """
    volume, truth = require_array("volume", volume), require_array("truth", truth)
    require_shape("volume", volume, truth.shape, "(z, y, x) of the truth")
    if not (np.isfinite(volume).all() and np.isfinite(truth).all()):
        raise fail("volume, truth", "finite values", "NaN or infinity")
    metal = np.zeros(truth.shape, bool) if metal_mask is None else np.asarray(metal_mask, bool)
    require_shape("metal_mask", metal, truth.shape, "(z, y, x) of the truth")
    if metal.all():
        raise fail("metal_mask", "a voxel that is not metal", "metal everywhere")
    rest = ~metal
    span = float(truth[rest].max())
    error = volume.astype(np.float64) - truth
    return {
        "psnr": psnr(error[rest], span),
        "psnr_all": psnr(error, float(truth.max())),
        "ssim": ssim(np.where(metal, 0, volume), np.where(metal, 0, truth), span),
        "rmse": float(np.sqrt(np.mean(np.square(error[rest])))),
    }


def psnr(error: np.ndarray, span: float) -> float:
    """Peak signal-to-noise ratio in dB, ``20 log10(span / rms(error))``; infinite without error."""
    rms = math.sqrt(float(np.mean(np.square(error, dtype=np.float64))))
    if span <= 0:
        raise fail("truth", "a positive largest value", f"{span:g}", "PSNR compares errors with it")
    return 20 * math.log10(span / rms) if rms > 0 else math.inf


def ssim(volume: np.ndarray, truth: np.ndarray, span: float) -> float:
    """Structural similarity (Wang et al. 2004, doi:10.1109/TIP.2003.819861) over 7-voxel windows.

    Axes of one voxel are dropped, and the window shrinks to the largest odd size that fits. Of two slices, which no
    window of three dimensions fits, it is the mean.
    """
    volume, truth = np.squeeze(volume).astype(np.float64), np.squeeze(truth).astype(np.float64)
    if truth.ndim == 3 and 2 in truth.shape:
        pair = truth.shape.index(2)
        return float(np.mean([ssim(volume.take(k, pair), truth.take(k, pair), span) for k in (0, 1)]))
    smallest = min(truth.shape, default=1)
    window = min(7, smallest - 1 + smallest % 2)
    if window < 3:
        raise fail("truth", "at least 3 voxels along each axis longer than one", f"shape {truth.shape}")
    margin = window // 2
    # By several threads: a volume of 256^3 takes one of them seconds.
    bounds = split_range(len(truth) - 2 * margin, _SLABS)
    slabs = [(volume[a : b + 2 * margin], truth[a : b + 2 * margin], span, window) for a, b in bounds]
    total = sum(run_tasks(_ssim_sum, slabs))
    return total / math.prod(n - 2 * margin for n in truth.shape)


def _ssim_sum(volume: np.ndarray, truth: np.ndarray, span: float, window: int) -> float:
    """Sum of the similarity over all windows that lie inside."""
    from skimage.metrics import structural_similarity

    _, similarity = structural_similarity(truth, volume, data_range=span, win_size=window, full=True)
    inside = slice(window // 2, -(window // 2))
    return float(similarity[(inside,) * truth.ndim].sum())

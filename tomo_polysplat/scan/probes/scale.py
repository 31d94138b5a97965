"""Is the logarithm the natural one? The noise tells: of Poisson counts var P = exp(P) / I0, of that logarithm only."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.probes.finding import OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured

__all__ = ["SCALE", "probe_scale"]

SCALE = "base of the logarithm"
_BINS, _FEWEST = 12, 40
# Slope of ln(variance) by P: 1 of natural logarithms, ln 10 of those to the base of 10.
_NATURAL, _DECADIC = 1.0, float(np.log(10.0))
# Standard errors by which one of them has to be ruled out, and by which the other may be off: downwards, and upwards to
# those of base 10. Detail that is taken for noise makes a law steeper.
_RULED_OUT, _EXPLAINED, _STEEPER = 4.0, 3.0, 1.0
# Noise of few photons, clipped at one, grows less: the other base is far.
_FAR = 6.0
# Of the scan's large values: beyond, other noise than that of counts may rule.
_DARKEST = 4.0
# Detail adds to the variance, by an amount that neighbouring views share less than noise: their ratio in pure noise.
_PURE, _TOLERANCE = np.sqrt(2.0), 0.12
_NEEDS = "ask how the values were made; a scan of fewer photons would tell"


def probe_scale(measured: Measured) -> Finding:
    """How the noise grows with P, where it is noise and not detail that neighbouring rays differ by; never a defect."""
    if measured.air is None:
        return Finding(SCALE, UNKNOWN, "no rays beside the object to compare the noise with", _NEEDS)
    values = measured.filled.astype(np.float64)
    if values.shape[1] < 4 or values.shape[2] < 9:
        return Finding(SCALE, UNKNOWN, "too few views or columns", _NEEDS)
    bend = values[..., 3:-1] - 2 * values[..., 2:-2] + values[..., 1:-3]
    # By the pixels beside the three, which have no part in the noise that is measured.
    level = 0.5 * (values[..., 4:] + values[..., :-4])
    change = np.diff(bend, axis=1)
    level, bend = 0.5 * (level[:, 1:] + level[:, :-1]), bend[:, 1:]
    found = _law(level.ravel(), bend.ravel(), change.ravel(), measured.air.noise)
    hidden = "the object's detail hides the noise, or its rays hardly differ in noise"
    if found is None:
        return Finding(SCALE, UNKNOWN, hidden, _NEEDS)
    slope, error = found
    numbers = {"slope": slope}
    text = f"the noise grows as exp({slope:.2f} P) (standard error {error:.2g})"
    beyond = slope - _DECADIC
    if slope - _NATURAL > _RULED_OUT * error and -_EXPLAINED * error - 0.25 < beyond < _STEEPER * error:
        # Detail that passes for noise does so too: of 110 clean scans it did in two.
        needs = "how the values were made: logarithms to the base of 10 must be multiplied by 2.3026"
        text = f"{text}, as of logarithms to the base of 10, or of fine detail"
        return Finding(SCALE, UNKNOWN, text, needs, numbers, error)
    if abs(slope - _NATURAL) < _EXPLAINED * error + 0.25 and _DECADIC - slope > _FAR * error:
        return Finding(SCALE, OK, f"{text}, as of natural logarithms", "", numbers, error)
    if beyond > _RULED_OUT * error:
        # Steeper than any logarithm of counts: it is not noise.
        text = hidden
    return Finding(SCALE, UNKNOWN, text, _NEEDS, numbers, error)


def _law(level: np.ndarray, bend: np.ndarray, change: np.ndarray, noise: float) -> tuple[float, float] | None:
    """Slope of ln(variance) by P with its standard error, over the bins that show pure noise; None of too few."""
    some = (level < _DARKEST) & (noise > 0)
    level, bend, change = level[some], bend[some], change[some]
    if len(level) < _BINS * _FEWEST:
        return None
    edges = np.linspace(float(level.min()), float(np.quantile(level, 0.995)), _BINS + 1)
    places, logs, weights = [], [], []
    for low, high in zip(edges[:-1], edges[1:]):
        inside = (level >= low) & (level < high)
        count = int(np.count_nonzero(inside))
        if count < _FEWEST:
            continue
        own, new = (1.4826 * float(np.median(np.abs(part[inside]))) for part in (bend, change))
        # The difference of two views has twice the variance, were it all noise.
        if own <= 0 or abs(new / own - _PURE) > _TOLERANCE + 2.0 / np.sqrt(count):
            continue
        places.append(float(np.median(level[inside])))
        logs.append(2 * np.log(new))
        weights.append(count)
    if len(places) < 4:
        return None
    x, y, w = (np.array(part, np.float64) for part in (places, logs, weights))
    # Of a median of absolute deviations: 1.17 / root n; neighbouring rays share half of theirs.
    w = w / (2 * (2 * 1.17) ** 2)
    mean = (w @ x) / w.sum()
    spread = w @ (x - mean) ** 2
    slope = float(w @ ((x - mean) * y) / spread)
    rest = y - (w @ y) / w.sum() - slope * (x - mean)
    inflated = max(1.0, float(w @ rest**2) / max(len(x) - 2, 1))
    return slope, float(np.sqrt(inflated / spread))

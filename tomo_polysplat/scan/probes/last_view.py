"""Is the last view as far from the first as told: has a turn n steps, or n - 1?"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured

__all__ = ["LAST_VIEW", "probe_last_view"]

LAST_VIEW = "last view"
# Steps by which the told gap may differ from none or one, and pixels by which the axis may from view to view.
_EVEN, _STILL = 0.1, 0.5
# Views are in one place if they differ by less than the first share of the least that neighbours do, squared, and in
# two if by more than the second: noise is in both.
_SAME, _OTHER = 0.5, 1.25
_FEWEST, _SURE = 16, 4.0
# Pixels that are averaged over, and columns that the axis of half a turn may be off by, with the steps between.
_SMOOTH, _OFF, _APART = 1.0, 2.0, 0.5


def probe_last_view(measured: Measured) -> Finding:
    """Compare what the last view differs from the first by with what neighbours differ by."""
    gap, half = _told_gap(measured)
    if gap is None:
        text = "the views do not end where they began, so nothing tells the last angle"
        return Finding(LAST_VIEW, UNKNOWN, text, "a look at where the stage went")
    where = "half a turn from the first" if half else "where the first is"
    unknown = f"whether the last view is {where}, or one step before, does not show"
    remedy = (
        "angles from numpy.linspace(..., endpoint=True) if the stage went all the way, else endpoint=False"
    )
    if measured.scan.views <= _FEWEST:
        return Finding(LAST_VIEW, UNKNOWN, unknown, remedy)
    column = float(np.median(measured.geometry.project_points(measured.axis[None])[:, 0, 0]))
    off = column + (np.arange(-_OFF, _OFF + _APART / 2, _APART) if half else np.zeros(1))
    light, least = _light(measured)
    closing = [
        _change(light[:, -1], light[:, 0] if not half else _mirrored(light[:, 0], place)) for place in off
    ]
    numbers = {"told": gap, "ratio": closing[len(off) // 2] / max(least, 1e-300)}
    # Squares of so many independent values.
    doubt = _SURE * np.sqrt(2 / max(light[:, 0].size / (4 * np.pi * _SMOOTH**2), 1.0))
    same = numbers["ratio"] * (1 + doubt) < _SAME
    other = min(closing) > (_OTHER + doubt) * least
    if same and gap == 1:
        text = f"the last view is {where}, and not one step before it as told"
        turn = "the angles want numpy.linspace(..., endpoint=True), or one view is there twice"
        return Finding(LAST_VIEW, DEFECT, text, turn, numbers)
    if same or (other and gap == 1):
        text = (
            where
            if gap == 0
            else "one step before half a turn from the first"
            if half
            else "one step before the first"
        )
        return Finding(LAST_VIEW, OK, f"{text}, as told", "", numbers)
    return Finding(LAST_VIEW, UNKNOWN, unknown, remedy, numbers)


def _told_gap(measured: Measured) -> tuple[float | None, bool]:
    """Steps from the last view to where the turn closes, 0 or 1, None elsewhere; and whether it is half a turn."""
    places, geometry = measured.places, measured.geometry
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    step = float(np.median(steps)) if len(steps) else 0.0
    if not step > 0 or np.abs(steps / step - 1).max() > _EVEN:
        return None, False
    gaps = {False: float(np.linalg.norm(places[-1] - places[0])) / step}
    if geometry.beam == "parallel":
        turned = np.diff(np.unwrap(measured.azimuth))
        axis = geometry.project_points(measured.axis[None])[:, 0]
        if np.ptp(axis, axis=0).max() < _STILL:
            gaps[True] = (np.pi - abs(float(turned.sum()))) / abs(float(np.median(turned)))
    for mirrored, gap in gaps.items():
        if min(abs(gap), abs(gap - 1)) < _EVEN:
            return float(round(gap)), mirrored
    return None, False


def _light(measured: Measured) -> tuple[np.ndarray, float]:
    """Transmissions (rows, views, columns) a little smoothed, and the least that neighbouring views differ by."""
    from scipy.ndimage import gaussian_filter

    light = np.exp(-np.clip(measured.filled, 0, None).astype(np.float64))
    together = len(measured.chosen_rows) == measured.scan.rows > 1
    light = gaussian_filter(light, (_SMOOTH * together, 0, _SMOOTH))
    return light, min(_change(one, two) for one, two in zip(light.swapaxes(0, 1), light.swapaxes(0, 1)[1:]))


def _change(one: np.ndarray, two: np.ndarray) -> float:
    """Variance of the difference of two views: a source that flickers has no part in it."""
    return float(np.var(one - two))


def _mirrored(view: np.ndarray, column: float) -> np.ndarray:
    """A view (rows, columns) as seen from the other side of the axis at this column."""
    where = np.clip(2 * column - np.arange(view.shape[1]), 0, view.shape[1] - 1)
    left = np.minimum(np.floor(where).astype(int), view.shape[1] - 2)
    share = where - left
    return (1 - share) * view[:, left] + share * view[:, left + 1]

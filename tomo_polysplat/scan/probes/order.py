"""Do the views belong to their places?"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.probes.alike import Alike
from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured

__all__ = ["ORDER", "blurred_views", "probe_order"]

ORDER = "order of views"
_MOST_VIEWS, _FEWEST_VIEWS, _FEWEST_BINS = 400, 8, 3
# Bins of fewer columns see a needle in one of their two halves only.
_BINS, _NARROWEST = 64, 4.0
# Bins are so many times as wide as the object's border moves from a view to the next, so that neighbours are alike.
_BLUR = 2.0
# Squared difference between neighbours by place, over that between any two views, and share of all views that are more
# alike than those: 1 and 1/2 for views in disorder, the second with a standard deviation of 0.29 over root n.
_UNLIKE, _RANDOM, _DEVIATION = 0.5, 0.35, 0.29
_SURE = 4.0
# Views of an object that looks the same from several sides are like many others, but neighbours differ by less than
# this share of what views two steps apart do; in disorder by as much.
_NEARER = 0.5
# A view in a wrong place differs from its neighbours by so many times as much as these do, squared, and by such a share
# of what any two views differ by; where it belongs it differs by less than half.
_FURTHER, _FAR, _ELSEWHERE = 2.5, 0.3, 0.5
# The share is less where neighbours hardly differ: so many times their median, but not less than the second.
_TIMES, _LEAST = 10.0, 0.05
# Two views look along one line if they are off it by less than so many steps from one view to the next.
_ONE_LINE = 0.75
# Share of the views that have to stand out in other places, for the order to be right.
_POWER = 0.2


def probe_order(measured: Measured) -> Finding:
    """Compare views that are neighbours by place with each other and with all others."""
    chosen = evenly_spread(measured.scan.views, _MOST_VIEWS)
    if len(chosen) < _FEWEST_VIEWS:
        return Finding(ORDER, UNKNOWN, "too few views to tell", f"{_FEWEST_VIEWS} views or more")
    places = measured.places[chosen]
    near, step = _neighbours(places)
    views = blurred_views(measured, chosen, float(np.median(step[:, 0])))
    if views.bins < _FEWEST_BINS:
        return Finding(ORDER, UNKNOWN, "neighbouring views are too far apart to be alike", "more views")
    squared = views.all_pairs()
    count = len(chosen)
    usual = float(squared.sum() / (count * (count - 1)))
    by_place = squared[np.arange(count), near[:, 0]]
    views.learn_noise(by_place)
    if usual < _SURE * max(float(views.error(usual)) / np.sqrt(count), 1e-12):
        text = "the views do not differ beyond their noise: any order is as good"
        return Finding(ORDER, UNKNOWN, text, "more light, or an object that is not round")
    ratio = float(by_place.mean() / usual)
    more_alike = (squared < by_place[:, None]) & ~np.eye(count, dtype=bool)
    rank = float(more_alike.mean())
    # Views count in pairs of neighbours.
    doubt = _DEVIATION / np.sqrt(count / 2)
    numbers = {"ratio": ratio, "rank": rank, "misplaced": 1.0}
    # In disorder the ratio is 1, as far as noise lets it be told.
    blurred = float(views.error(usual)) / usual / np.sqrt(count / 2)
    ordered = by_place.mean() < _NEARER * squared[np.arange(count), _two_steps_away(near)].mean()
    if not ordered and ratio > max(_UNLIKE, _SURE * blurred) and rank > max(0.5 - 3 * doubt, _RANDOM):
        text = f"of any two views {100 * rank:.0f} % are more alike than those from neighbouring places"
        remedy = "the angles do not belong to the views in this order: check the order of the files"
        return Finding(ORDER, DEFECT, text, remedy, numbers, doubt)
    wrong = _misplaced(views, squared, near, _from_the_other_end(measured.azimuth[chosen], near), usual)
    numbers["misplaced"] = len(wrong) / count
    if len(wrong):
        named = ", ".join(map(str, chosen[wrong[:8]])) + (", ..." if len(wrong) > 8 else "")
        text = f"views {named} do not look like their neighbours, but like views from elsewhere"
        return Finding(ORDER, DEFECT, text, "leave them out, or mend their order or angle", numbers, doubt)
    shows = _would_show(views, squared, near, usual) >= _POWER
    return _in_order(numbers, doubt, shows)


def _in_order(numbers: dict[str, float], doubt: float, shows: bool) -> Finding:
    """What to say where nothing is seen to be misplaced.

    Parameters
    ----------
    numbers : dict
        With ``ratio`` and ``rank``.
    doubt : float
        Standard error of the rank.
    shows : bool
        Whether misplaced views would be seen.
    """
    ratio, rank = numbers["ratio"], numbers["rank"]
    text = f"neighbouring views differ by {100 * max(ratio, 0):.2g} % of what any two views differ by"
    if ratio < _UNLIKE and rank < _RANDOM and not shows:
        text += ", but many would not stand out elsewhere either"
        return Finding(ORDER, UNKNOWN, text, "more light, or an object that is not round", numbers, doubt)
    if ratio < _UNLIKE and rank < _RANDOM:
        return Finding(ORDER, OK, text, "", numbers, doubt)
    return Finding(ORDER, UNKNOWN, text, "more views, or more light", numbers, doubt)


def blurred_views(measured: Measured, chosen: np.ndarray, step: float) -> Alike:
    """Some of the views, blurred so that those are alike that are `step` pixels apart half-way to the border."""
    values = measured.filled[:, chosen]
    width = max(2 * _BLUR * step, values.shape[2] / _BINS, _NARROWEST)
    spacing = measured.scan.rows / len(measured.chosen_rows)
    return Alike(values, width, max(int(np.ceil(width / spacing)), len(values) // 8))


def _neighbours(places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The two views nearest by place and their distances in pixels, (views, 2) each."""
    from scipy.spatial import cKDTree

    distance, index = cKDTree(places).query(places, k=3)
    own = np.arange(len(places))
    # Of views in the same place any may come first.
    others = np.array([line[line != view][:2] for line, view in zip(index, own)])
    apart = np.linalg.norm(places[others] - places[:, None], axis=2)
    return others, apart


def _two_steps_away(near: np.ndarray) -> np.ndarray:
    """The other neighbour of each view's nearest one, (views,)."""
    first, second = near[near[:, 0]].T
    return np.where(first == np.arange(len(near)), second, first)


def _from_the_other_end(azimuth: np.ndarray, near: np.ndarray) -> np.ndarray:
    """(views, views) whether views look at each other along one line, within less than a step."""

    def apart(angle: np.ndarray) -> np.ndarray:
        return np.abs(np.mod(angle + np.pi, 2 * np.pi) - np.pi)

    step = float(np.median(apart(azimuth - azimuth[near[:, 0]])))
    return apart(azimuth[:, None] - azimuth + np.pi) < _ONE_LINE * step


def _misplaced(
    views: Alike, squared: np.ndarray, near: np.ndarray, other_end: np.ndarray, usual: float
) -> np.ndarray:
    """Views unlike both of their neighbours, which are like each other, and like views from elsewhere.

    A plate seen edge-on is unlike its neighbours too, and like the view from its other end, which is as unlike its own.
    That one is no evidence: a view that belongs there is like those beside it.
    """
    own = np.arange(len(near))
    nearer = np.minimum(squared[own, near[:, 0]], squared[own, near[:, 1]])
    elsewhere = squared.copy()
    elsewhere[own[:, None], near] = elsewhere[own, own] = elsewhere[other_end] = np.inf
    typical = float(np.median(nearer))
    shows = _shows(views, nearer, squared[near[:, 0], near[:, 1]], elsewhere.min(axis=1), typical, usual)
    twins = other_end & (np.maximum(squared, 0) < _ELSEWHERE * nearer[:, None])
    twins &= nearer > _ELSEWHERE * nearer[:, None]
    return np.flatnonzero(shows & ~twins.any(axis=1))


def _would_show(views: Alike, squared: np.ndarray, near: np.ndarray, usual: float) -> float:
    """Share of the views that would be seen to be misplaced, were each half a scan away."""
    own = np.arange(len(near))
    there = np.roll(near, len(near) // 2, axis=0)
    nearer = np.minimum(squared[own, there[:, 0]], squared[own, there[:, 1]])
    at_home = np.minimum(squared[own, near[:, 0]], squared[own, near[:, 1]])
    between = squared[there[:, 0], there[:, 1]]
    return float(_shows(views, nearer, between, at_home, float(np.median(at_home)), usual).mean())


def _shows(
    views: Alike, nearer: np.ndarray, between: np.ndarray, like: np.ndarray, typical: float, usual: float
) -> np.ndarray:
    """Whether views that differ so much from the nearer neighbour, and less from another view, are misplaced.

    Parameters
    ----------
    nearer, between, like : (views,) arrays
        Squared difference of a view from the nearer of its neighbours, of these from each other, and of the view from
        the one it is most like.
    typical, usual : float
        Median of the first over a scan in order, and mean of any two views.
    """
    # What is known of the noise is wrong by as much as a squared difference less it lies below 0.
    error = np.maximum(views.error(nearer), -between)
    apart = nearer - _FURTHER * np.maximum(between, 0) > _SURE * error
    apart &= nearer > np.clip(_TIMES * typical, _LEAST * usual, _FAR * usual)
    # The best of many: chance finds one more easily.
    return apart & (like < _ELSEWHERE * nearer) & (nearer - like > _SURE * 1.5 * error)

"""Do the views come in the order of their angles?"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.probes.measured import Finding, Measured

__all__ = ["probe_order"]

_MOST_VIEWS, _BINS = 400, 64
# Median distance between views that are neighbours by angle: over that between views that are most alike, and
# over that between any two. Only both together mean disorder: views of a symmetric object are alike in pairs.
_UNLIKE, _ANY = 1.8, 0.75
# A view in a wrong place: its deviation from the mean of its neighbours, over the median deviation; and how much
# further it is from either neighbour than they are from each other.
_DEVIATES, _FURTHER = 2.5, 1.5


def probe_order(measured: Measured) -> Finding:
    """Compare views that are neighbours by angle with each other and with the views most like them."""
    if measured.scan.views < 12:
        return Finding("order of views", "unknown", "too few views to tell")
    order = np.argsort(measured.azimuth, kind="stable")
    step = -(-len(order) // _MOST_VIEWS)
    images = _images(measured.filled)[order[::step]]
    distance = np.sqrt(np.maximum(_squared_distances(images), 0))
    count = len(images)
    following = distance[np.arange(count - 1), np.arange(1, count)]
    usual = float(np.median(distance[np.triu_indices(count, 1)]))
    np.fill_diagonal(distance, np.inf)
    ratio = float(np.median(following) / max(np.median(distance.min(axis=1)), 1e-30))
    if ratio > _UNLIKE and np.median(following) > _ANY * usual:
        text = f"views at neighbouring angles differ {ratio:.1f} times more than views that are alike"
        remedy = "the angles do not belong to the views in this order: check the order of the files"
        return Finding("order of views", "defect", text, remedy, {"ratio": ratio, "misplaced": 1.0})
    deviation = np.linalg.norm(images[1:-1] - 0.5 * (images[:-2] + images[2:]), axis=1)
    skipping = distance[np.arange(count - 2), np.arange(2, count)]
    nearer = np.minimum(following[:-1], following[1:])
    misplaced = (deviation > _DEVIATES * np.median(deviation)) & (nearer > _FURTHER * skipping)
    wrong = np.sort(order[::step][1:-1][misplaced]).tolist()
    numbers = {"ratio": ratio, "misplaced": len(wrong) / count}
    if wrong:
        named = ", ".join(map(str, wrong[:8])) + (", ..." if len(wrong) > 8 else "")
        text = f"views {named} do not look like their neighbours, which look like each other"
        return Finding(
            "order of views", "defect", text, "leave them out, or mend their order or angle", numbers
        )
    return Finding("order of views", "ok", "every view looks like its neighbours", "", numbers)


def _images(values: np.ndarray) -> np.ndarray:
    """Views as vectors of a few hundred values, (views, n)."""
    rows, views, columns = values.shape
    across = np.array_split(np.arange(columns), min(_BINS, columns))
    down = np.array_split(np.arange(rows), min(8, rows))
    binned = np.stack([values[..., part].mean(axis=2) for part in across], axis=2)
    return np.stack([binned[part].mean(axis=0) for part in down], axis=1).reshape(views, -1)


def _squared_distances(images: np.ndarray) -> np.ndarray:
    images = images.astype(np.float64)
    squares = (images**2).sum(axis=1)
    return squares[:, None] + squares[None] - 2 * images @ images.T

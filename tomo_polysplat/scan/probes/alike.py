"""How much views differ, free of noise and of what each view has everywhere."""

from __future__ import annotations

import numpy as np

__all__ = ["Alike"]

# Of the difference between pixels, so much is noise at least.
_LEAST_NOISE = 0.3


class Alike:
    """Views as a few hundred values each, taken twice from different pixels.

    Noise is not the same in the two, so that the mean product of two differences has none of it: it is the squared
    difference of what was seen. The mean over a view is taken away, for a source that flickers.

    Parameters
    ----------
    values : (rows, views, columns) array
        Without holes.
    width : float
        Pixels that are averaged across: detail that moves by less from a view to the next is seen to move.
    height : int
        Rows that `values` has between two bins, at least 1.
    """

    def __init__(self, values: np.ndarray, width: float, height: int) -> None:
        rows, views, columns = values.shape
        self.bins = int(min(columns // 2, columns / max(width, 2)))
        first, second = (
            _binned(values[..., start : columns - columns % 2 : 2], max(self.bins, 1), height)
            for start in (0, 1)
        )
        middle = 0.5 * (first + second).mean(axis=1, keepdims=True)
        self.first, self.second = first - middle, second - middle
        # Of half of the difference of two values: what noise does to one, and the little that the pixels differ in.
        self.noise = 0.5 * float(((first - second) ** 2).mean())

    def between(self, one: np.ndarray, other: np.ndarray) -> np.ndarray:
        """Mean squared differences of views `one` from views `other`, free of noise and thus below 0 by chance."""
        differences = (part[one] - part[other] for part in (self.first, self.second))
        return np.multiply(*differences).mean(axis=-1)

    def all_pairs(self) -> np.ndarray:
        """The same of every view from every other, (views, views)."""
        size = self.first.shape[1]
        products = self.first @ self.second.T / size
        own = np.diag(products)
        return own[:, None] + own[None] - products - products.T

    def learn_noise(self, squared: np.ndarray) -> None:
        """Take the noise from the scatter of what ought to be alike, where that is less: pixels' detail is no noise."""
        scatter = 1.4826 * float(np.median(np.abs(squared - np.median(squared))))
        learnt = max(0.5 * scatter * self.first.shape[1] ** 0.5, _LEAST_NOISE * self.noise)
        self.noise = min(self.noise, learnt)

    def error(self, squared: np.ndarray | float) -> np.ndarray:
        """Standard error from noise of a squared difference."""
        # (d + a)(d + b) with a and b of variance 2 s^2 each: d (a + b) + a b.
        noise = 2 * self.noise
        spread = 2 * noise * np.maximum(squared, 0) + noise**2
        return np.sqrt(spread / self.first.shape[1])


def _binned(values: np.ndarray, bins: int, height: int) -> np.ndarray:
    """Means over bins of rows and columns, (views, n)."""
    rows, views, columns = values.shape
    across = np.array_split(np.arange(columns), bins)
    down = np.array_split(np.arange(rows), max(1, rows // max(height, 1)))
    binned = np.stack([values[..., part].mean(axis=2) for part in across], axis=2)
    return np.stack([binned[part].mean(axis=0) for part in down], axis=1).reshape(views, -1)

"""The least and the largest value of rays, a few views at a time, so that nothing large is made."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.parallel import of_parts

__all__ = ["largest", "least"]


def least(values: np.ndarray, above: float | None = None) -> float:
    """The least value, of those above another one where that is told; NaN is left out, infinity where there is none."""
    return _extreme(np.fmin, values, above)


def largest(values: np.ndarray, below: float | None = None) -> float:
    """The largest value, of those below another one where that is told; NaN is left out, minus infinity for none."""
    return _extreme(np.fmax, values, below)


def _extreme(of: np.ufunc, values: np.ndarray, short_of: float | None) -> float:
    beyond, none = (np.greater, np.inf) if of is np.fmin else (np.less, -np.inf)

    def look(part: np.ndarray) -> float:
        # Of what is not left out, in a tenth of the time. Not the minimum, which NaN would be.
        most = float(of.reduce(part, axis=None))
        if short_of is None or beyond(most, short_of) or np.isnan(most):
            return most
        return float(of.reduce(part, axis=None, initial=none, where=beyond(part, short_of)))

    return float(of.reduce(of_parts(look, values), initial=none))

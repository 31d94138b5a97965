"""A constant scattered signal on top of what passes: ``I / I0 = sum_E eta(E) exp(-...) + s``.

The open beam I0 is taken without the object, so scatter from the object adds to every ray, air included. In
the quadrature that is one more node which nothing attenuates; the weights then add up to ``1 + s``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from tomo_polysplat.checks import require_array, require_number
from tomo_polysplat.physics.quadrature import Quadrature

__all__ = ["add_scatter", "without_scatter"]


def add_scatter(quadrature: Quadrature, scatter: float) -> Quadrature:
    """Nodes of the same spectrum under a scattered signal, a fraction of the open beam; 0 adds none."""
    if require_number("scatter", scatter, at_least=0.0) == 0:
        return quadrature
    log_weights = np.append(quadrature.log_weights, np.log(scatter))
    attenuation = np.pad(quadrature.attenuation, ((0, 0), (0, 1)))
    return replace(quadrature, log_weights=log_weights, attenuation=attenuation)


def without_scatter(projections: Any, scatter: float, largest: float) -> np.ndarray:
    """Projection values of what passes alone.

    Parameters
    ----------
    projections : array_like
        ``-log(I / I0)``, of any shape; NaN is kept.
    scatter : float
        As a fraction of the open beam.
    largest : float
        Value of the rays that noise leaves with less signal than scatter.

    Returns
    -------
    array of float64
    """
    values = require_array("projections", projections).astype(np.float64)
    return -np.log(np.maximum(np.exp(-values) - scatter, np.exp(-largest)))

"""Undoing a water correction: the polynomial that a scanner put its projections through.

A polynomial of one ray's value changes neither which rays there are nor what is known of each, as long as it
rises: a model of the corrected values with the noise they have is a model of the values before it. So the
correction is undone once, before anything else, and every ray keeps the weight that its counts give it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import DTypeLike

from tomo_polysplat.checks import fail, require_array
from tomo_polysplat.parallel import run_tasks, split_range
from tomo_polysplat.physics.spectrum import Spectrum

__all__ = [
    "describe_polynomial",
    "require_water_correction",
    "undo_water_correction",
    "usual_water_correction",
]

_TABLE = 4096
_DEGREE = 6
_NEWTON_STEPS = 3
_PART = 1 << 18
_REMEDY = "ascending powers of P as in (0, 1, 0.02) for P + 0.02 P^2"


def require_water_correction(coefficients: Any) -> tuple[float, ...]:
    """Coefficients ``c_k`` of ``P_corrected = sum_k c_k P^k``, checked.

    Raises
    ------
    ValueError
        Unless they are finite, ``c_0`` is 0 (air stays 0) and ``c_1`` is above 0 (a thin object attenuates).
    """
    values = require_array("water_correction", coefficients, 1, _REMEDY).astype(np.float64)
    if len(values) < 2 or not np.isfinite(values).all():
        raise fail("water_correction", "at least two finite coefficients", repr(coefficients), _REMEDY)
    if values[0] != 0 or values[1] <= 0:
        got = f"c_0 = {values[0]:g}, c_1 = {values[1]:g}"
        raise fail("water_correction", "c_0 = 0 and c_1 > 0", got, _REMEDY)
    return tuple(map(float, values))


def usual_water_correction(spectrum: Spectrum, largest: float) -> tuple[float, ...]:
    """The polynomial of a scanner that corrects for water under a spectrum, for who does not know it.

    Parameters
    ----------
    spectrum : Spectrum
    largest : float
        Largest corrected value that there is.

    Returns
    -------
    tuple of float
        ``c_0`` (0), ``c_1``, ...: within 0.01 of `water_linearised` for tubes of 60 to 140 kV behind 1 to 8 mm of
        aluminium and values up to 12. It rises beyond ``largest``. Water of 1 g/cm3 gets its attenuation at the
        spectrum's effective energy.

    Raises
    ------
    ValueError
        If ``largest`` is not above 0.
    """
    if not 0 < largest < np.inf:
        raise fail("largest", "a value above 0", repr(largest), "give the largest value of the projections")
    # Torch is not loaded where a scan is only read.
    from tomo_polysplat.physics.water import water_linearised

    # Beyond what is needed, so that noise on the largest value is undone too.
    measured = 1.2 * largest * np.linspace(0.0, 1.0, _TABLE)[1:]
    wanted = water_linearised(measured, spectrum)
    for degree in range(_DEGREE, 1, -1):
        powers = measured[:, None] ** np.arange(1, degree + 1)
        coefficients = np.linalg.lstsq(powers, wanted, rcond=None)[0]
        if (np.diff(powers @ coefficients) > 0).all() and coefficients[0] > 0:
            return (0.0, *map(float, coefficients))
    return (0.0, float(wanted @ measured / (measured @ measured)))


def describe_polynomial(coefficients: Sequence[float]) -> str:
    """A few words for reports, such as ``"P + 0.02 P^2"``."""
    powers = {0: "", 1: " P"}
    terms = [f"{c:g}{powers.get(k, f' P^{k}')}" for k, c in enumerate(coefficients) if c]
    return " + ".join(terms).replace("+ -", "- ")


def undo_water_correction(
    corrected: Any, coefficients: Sequence[float], dtype: DTypeLike = np.float64
) -> np.ndarray:
    """Projection values before a water correction.

    Parameters
    ----------
    corrected : array_like
        ``sum_k c_k P^k`` of every ray, of any shape; what is not finite stays as it is.
    coefficients : sequence of float
        ``c_0`` (0), ``c_1`` (above 0), ... in ascending powers of P, as ``numpy.polynomial`` has them.
    dtype : dtype
        Of the result; it is worked out in float64.

    Returns
    -------
    array
        ``P = -log(I/I0)`` in the shape of ``corrected``, exact to rounding.

    Raises
    ------
    ValueError
        If the polynomial does not rise all the way from 0 to the values that there are: some of them then
        stand for no P, or for two.
    """
    polynomial = Polynomial(require_water_correction(coefficients))
    values = np.ascontiguousarray(require_array("corrected", corrected))
    flat, undone = values.reshape(-1), np.empty(values.size, dtype)
    # By parts: a scan in float64, several times over, may not fit into memory.
    parts = split_range(flat.size, -(-flat.size // _PART))
    finite = [(part.min(), part.max()) for a, b in parts if (part := flat[a:b][np.isfinite(flat[a:b])]).size]
    low = _reach(polynomial, float(min([0.0, *(lowest for lowest, _ in finite)])))
    high = _reach(polynomial, float(max([0.0, *(highest for _, highest in finite)])))
    grid = np.linspace(low, high, _TABLE)
    table, slope = np.asarray(polynomial(grid), np.float64), polynomial.deriv()

    def undo(begin: int, end: int) -> None:
        wanted = flat[begin:end].astype(np.float64)
        known = np.isfinite(wanted)
        target = np.where(known, wanted, 0.0)
        found = np.interp(target, table, grid)
        for _ in range(_NEWTON_STEPS):
            # The slope may come close to 0 at the ends, where a step must not leave the rising part.
            found = np.clip(found - (polynomial(found) - target) / np.maximum(slope(found), 1e-12), low, high)
        undone[begin:end] = np.where(known, found, wanted)

    run_tasks(undo, parts)
    return undone.reshape(values.shape)


def _reach(polynomial: Polynomial, value: float) -> float:
    """The P nearest to 0 at which the polynomial has a value, if it rises all the way to it."""
    candidates = _real_roots(polynomial - value, np.sign(value))
    turns = _real_roots(polynomial.deriv(), np.sign(value))
    if value == 0:
        return 0.0
    first = min(candidates, key=abs, default=np.inf)
    turn = min(turns, key=abs, default=np.inf)
    if not abs(first) <= abs(turn) or not np.isfinite(first):
        where = f"it turns at P = {turn:g}" if np.isfinite(turn) else "it never gets there"
        expected = f"a polynomial that rises from 0 to {value:.4g}, the extreme value measured"
        remedy = "check the coefficients and their order, or mark bad rays with valid="
        raise fail("water_correction", expected, where, remedy)
    return float(first)


def _real_roots(polynomial: Polynomial, sign: float) -> list[float]:
    """Real roots on one side of 0."""
    roots = polynomial.trim().roots()
    real = roots[np.abs(np.imag(roots)) <= 1e-9 * np.maximum(np.abs(roots), 1e-12)]
    return [float(root) for root in np.real(real) if root * sign > 0]

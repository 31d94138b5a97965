"""A scan as if of one material: the inverse of its polychromatic projection, and the water correction."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np
import torch

from tomo_polysplat.checks import require_array
from tomo_polysplat.parallel import run_tasks, split_range
from tomo_polysplat.physics.beer_lambert import shares
from tomo_polysplat.physics.materials import MaterialLike, mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.typical import typical_value

__all__ = ["areal_density", "transmitted_energy", "water_linearised"]

# Nodes of the inverse, and of the table that places them.
_NODES, _STEPS = 16384, 2048
# Values looked up at once: the intermediate results are several times as large.
_CHUNK = 1 << 22
# On a CPU, so few that torch shares them out over no threads: vectors, and with them bits, would begin elsewhere.
_PART = 1 << 15


def areal_density(
    projections: Any, spectrum: Spectrum, material: MaterialLike = "water", *, spare: bool = False
) -> Any:
    """Areal density of a material (g/cm2) that gives the measured projection values.

    Parameters
    ----------
    projections : array_like or tensor
        ``P = -log(I / I0)``, of any shape. Negative values (noise in air) continue the curve linearly with
        its slope at 0, so that noise stays unbiased; NaN and infinity are kept.
    spectrum : Spectrum
        Detected spectrum of the scan.
    material : str or mapping
        What the object is taken for: anything ``mass_attenuation`` accepts.
    spare : bool
        Whether nobody needs a contiguous tensor of ``projections`` afterwards, so that it may be overwritten.

    Returns
    -------
    array of float64, or float32 tensor on the device of ``projections``
        In their shape; before it is rounded, within 1e-6 relative of the exact inverse from a thousandth of
        the largest value on.
    """
    if isinstance(projections, torch.Tensor):
        line = projections.reshape(-1)
        return _inverted(line, spectrum, material, spare).reshape(projections.shape)
    values = require_array("projections", projections).astype(np.float64)
    flat = torch.from_numpy(values.reshape(-1))
    return _inverted(flat, spectrum, material).numpy().reshape(values.shape)


def _inverted(
    values: torch.Tensor, spectrum: Spectrum, material: MaterialLike, spare: bool = False
) -> torch.Tensor:
    """The inverse of the material's curve at ``values``, (n,) both, in their place if they are ``spare``."""
    density = values if spare else torch.empty_like(values)
    largest = max((float(values[a:b].nan_to_num(0, 0, 0).max()) for a, b in _chunks(values)), default=0.0)
    nodes, slope = _inverse(spectrum, max(largest, 1.0), material)
    table = torch.from_numpy(nodes).to(values.device)
    scale = (_NODES - 1) / max(largest, 1.0) ** (1 / 3)

    def look_up(first: int, last: int) -> None:
        part = values[first:last].double()
        place = part.clamp(min=0).pow_(1 / 3).mul_(scale)
        index = place.nan_to_num(0).clamp_(max=_NODES - 2).long()
        left = table[index]
        found = torch.addcmul(left, table[index + 1] - left, place - index)
        density[first:last] = torch.where(part < 0, part / slope, found)

    if values.is_cuda:
        for a, b in _chunks(values):
            look_up(a, b)
    else:
        run_tasks(look_up, [(a, min(a + _PART, len(values))) for a in range(0, len(values), _PART)])
    return density


def _chunks(values: torch.Tensor) -> list[tuple[int, int]]:
    return split_range(values.numel(), -(-values.numel() // _CHUNK)) if values.numel() else []


def _inverse(spectrum: Spectrum, largest: float, material: MaterialLike) -> tuple[np.ndarray, float]:
    """Areal densities at evenly spaced cube roots of P up to ``largest``, and dP by areal density at 0."""
    path_of, slope = _path_of(spectrum, largest, material)
    return path_of(largest * np.linspace(0.0, 1.0, _NODES) ** 3), slope


def _path_of(
    spectrum: Spectrum, largest: float, material: MaterialLike
) -> tuple[Callable[[Any], np.ndarray], float]:
    """The areal density by P, from 0 to ``largest``, and dP by areal density at 0."""
    # A run asks twice for that of its typical ray, and every run of one scan for the same two.
    return (_known_path if isinstance(material, str) else _new_path)(spectrum, largest, material)


def _new_path(
    spectrum: Spectrum, largest: float, material: MaterialLike
) -> tuple[Callable[[Any], np.ndarray], float]:
    # Not needed where there is no spectrum.
    from scipy.interpolate import CubicHermiteSpline

    log_weights, _, curve = _curve(spectrum, material)
    # P rises at least as fast as at its hardest energy, so this path reaches the largest value. Cubic spacing
    # follows the curve, which bends most at 0 where the soft photons still count.
    paths = largest / curve.min() * np.linspace(0.0, 1.0, _STEPS) ** 3
    value, share = shares(paths[None], log_weights, curve)
    # Exactly 0 without matter, whatever the sum of the weights was rounded to.
    value[0] = 0.0
    rise = curve[0] @ share
    return CubicHermiteSpline(value, paths, 1 / rise), float(rise[0])


_known_path = lru_cache(maxsize=8)(_new_path)


def _curve(spectrum: Spectrum, material: MaterialLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Logarithms of the weights (n,), energies (n,) and mass attenuation (1, n), where there are photons."""
    lit = spectrum.weights > 0
    energies = spectrum.energies[lit]
    return np.log(spectrum.weights[lit]), energies, mass_attenuation(material, energies)[None]


def water_linearised(projections: Any, spectrum: Spectrum) -> np.ndarray:
    """What a monochromatic scan at the effective energy would have measured, were the object water.

    The usual water correction: ``mu_water(E_eff)`` (cm2/g) times ``areal_density`` of water. Same shape, float64.
    """
    return float(mass_attenuation("water", spectrum.effective_energy)) * areal_density(projections, spectrum)


def transmitted_energy(projections: Any, spectrum: Spectrum) -> float:
    """Mean energy (keV) of what a typical ray through the object transmits, were the object water.

    Typical is the median of the values above a tenth of the largest.
    """
    if not isinstance(projections, torch.Tensor):
        projections = torch.from_numpy(np.ascontiguousarray(require_array("projections", projections)))
    value = typical_value(projections)
    if value is None:
        return spectrum.effective_energy
    # Of a range too short, rounding would decide which of two values is the larger.
    path = _path_of(spectrum, max(value, 1.0), "water")[0](value)
    log_weights, energies, curve = _curve(spectrum, "water")
    return float(energies @ shares(np.array([path]), log_weights, curve)[1])

"""Packaged x-ray tube spectra and their interpolation to any tube voltage.

The tables (``data/tube_spectra.npz``, made by ``scripts/make_tube_spectra.py``) hold unfiltered spectra
computed with SpekPy 2.5.4 (Poludniowski et al. 2021, doi:10.1002/mp.14945): model "casim", reflection target,
anode angle 12 degrees, 1 keV bins, every 2 kVp up to 60 kVp, every 5 kVp up to 225, every 25 above. Tungsten covers
20 to 450 kVp, the other anodes 20 to 50.

Between two tabulated voltages both parts are interpolated linearly, each after a change of variable that
makes it nearly linear:

* bremsstrahlung divided by (kVp - E), its behaviour at the end point. A table is read at the same energy for
  soft photons, where the anode's absorption edges must stay put, and at the same distance from the end point
  for the hardest.
* characteristic lines raised to 1/1.63, since a line's yield grows as (kVp / edge - 1)^1.63 (Green and
  Cosslett 1961).
"""

from __future__ import annotations

from functools import lru_cache
from importlib.resources import files

import numpy as np

from tomo_polysplat.checks import require_choice, require_number

__all__ = ["anode_symbol", "anodes", "tube_counts", "voltage_range"]

_LINE_GROWTH = 1.63
_END_POINT_POWER = 8  # of 1, 4, 8, 12, 16 the closest to SpekPy in between: 2e-4 of the peak, rms
_ELEMENTS = {
    "tungsten": "W",
    "wolfram": "W",
    "molybdenum": "Mo",
    "rhodium": "Rh",
    "silver": "Ag",
    "copper": "Cu",
    "gold": "Au",
}
_FIRST_CENTRE = 1.5  # keV; SpekPy gives nothing below 1 keV


@lru_cache(maxsize=1)
def _tables() -> dict[str, np.ndarray]:
    path = files("tomo_polysplat.physics") / "data" / "tube_spectra.npz"
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as archive:
        return {name: archive[name] for name in archive.files}


def anodes() -> list[str]:
    """Anode materials with tables, such as ``["W", "Mo", ...]``."""
    return [name[: -len("_kvp")] for name in _tables() if name.endswith("_kvp")]


def anode_symbol(name: str) -> str:
    """The symbol of an anode's element, by which its tables are named, of ``"W"``, ``"w"`` or ``"tungsten"``.

    Raises
    ------
    ValueError
        For an anode without tables.
    """
    symbols = {symbol.lower(): symbol for symbol in anodes()}
    known = _ELEMENTS.get(name.lower()) or symbols.get(name.lower()) if isinstance(name, str) else None
    return known or require_choice("anode", name, anodes(), "else pass Spectrum(energies_kev, weights)")


def voltage_range(anode: str = "W") -> tuple[float, float]:
    """Lowest and highest tube voltage (kVp) of an anode's tables."""
    voltages = _tables()[f"{anode_symbol(anode)}_kvp"]
    return float(voltages[0]), float(voltages[-1])


def tube_counts(kvp: float, anode: str = "W") -> tuple[np.ndarray, np.ndarray]:
    """Photons of an unfiltered tube.

    Parameters
    ----------
    kvp : float
        Tube voltage in kV, within ``voltage_range(anode)``: 20 to 450 for tungsten.
    anode : str
        One of ``anodes()``.

    Returns
    -------
    energies : (n,) array
        Bin centres in keV: 1 keV bins from 1 keV, the last one cut at ``kvp``.
    counts : (n,) array
        Photons per bin, cm2 and mAs at 1 m.

    Raises
    ------
    ValueError
        For an unknown anode, or a voltage outside its tables.
    """
    lowest, highest = voltage_range(anode)
    covered = (
        f"the tables of anode {anode} cover {lowest:g}-{highest:g} kVp; else Spectrum(energies, weights)"
    )
    kvp = require_number("kvp", kvp, at_least=lowest, at_most=highest, remedy=covered)
    edges = np.append(np.arange(1.0, np.ceil(kvp)), kvp)
    energies = 0.5 * (edges[1:] + edges[:-1])
    anode = anode_symbol(anode)
    counts = _bremsstrahlung(kvp, anode, energies) * np.diff(edges)
    _add_lines(counts, energies, *_lines(kvp, anode))
    return energies, counts


def _bracket(kvp: float, anode: str) -> list[tuple[int, float]]:
    """The one or two tables around a voltage with their linear weights."""
    voltages = _tables()[f"{anode}_kvp"]
    upper = int(np.searchsorted(voltages, kvp))
    if voltages[upper] == kvp:
        return [(upper, 1.0)]
    share = (kvp - voltages[upper - 1]) / float(voltages[upper] - voltages[upper - 1])
    return [(upper - 1, 1.0 - share), (upper, share)]


def _bremsstrahlung(kvp: float, anode: str, energies: np.ndarray) -> np.ndarray:
    """Photons per keV at the given energies."""
    total = np.zeros_like(energies)
    for row, share in _bracket(kvp, anode):
        tabulated = float(_tables()[f"{anode}_kvp"][row])
        centres = np.arange(_FIRST_CENTRE, tabulated)
        density = _tables()[f"{anode}_bremsstrahlung"][row, 1 : 1 + centres.size] / (tabulated - centres)
        position = energies + (tabulated - kvp) * (energies / kvp) ** _END_POINT_POWER
        total += share * np.interp(position, centres, density) * (tabulated - position)
    return total


def _lines(kvp: float, anode: str) -> tuple[np.ndarray, np.ndarray]:
    """Energies (keV) and photons of the characteristic lines."""
    table = _tables()[f"{anode}_line_counts"].astype(np.float64)
    root = sum(share * table[row] ** (1.0 / _LINE_GROWTH) for row, share in _bracket(kvp, anode))
    return _tables()[f"{anode}_line_kev"].astype(np.float64), np.asarray(root) ** _LINE_GROWTH


def _add_lines(counts: np.ndarray, energies: np.ndarray, kev: np.ndarray, photons: np.ndarray) -> None:
    """Share each line between its two neighbouring bins so that its photons and its energy are kept."""
    position = np.interp(kev, energies, np.arange(energies.size))
    lower = np.minimum(position.astype(int), energies.size - 2)
    np.add.at(counts, lower, photons * (1.0 - (position - lower)))
    np.add.at(counts, lower + 1, photons * (position - lower))

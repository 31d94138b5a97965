"""Mass attenuation of materials.

Element data: total attenuation with coherent scattering from the Elam tables of xraydb (Elam, Ravel and
Sieber 2002, doi:10.1016/S0969-806X(01)00227-4); within 2 % of NIST's XAAMDI for 20-100 keV. Compounds and
mixtures add by mass.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from tomo_polysplat.checks import did_you_mean, fail, require_array, require_number
from tomo_polysplat.physics.mixtures import ALIASES, NAMED

__all__ = [
    "MaterialLike",
    "composition",
    "density",
    "known_density",
    "mass_attenuation",
    "require_energies",
]

logger = logging.getLogger(__name__)

MaterialLike = str | Mapping[str, float]
ENERGY_RANGE_KEV = (0.1, 800.0)
_HEAVIEST = 98  # atomic number of the last element with tables
_FRACTION_TOLERANCE = 0.01  # published compositions are rounded


def mass_attenuation(material: MaterialLike, energies_kev: Any) -> np.ndarray:
    """Total mass attenuation coefficient.

    Parameters
    ----------
    material : str or mapping
        An element (``"Fe"`` or ``"iron"``), a chemical formula (``"ZrO2"``), a named material (``"bone"``,
        ``"stainless steel"``, ...) or mass fractions (``{"Ti": 0.9, "Al": 0.06, "V": 0.04}``).
    energies_kev : array_like
        Photon energies in keV, 0.1 to 800, of any shape.

    Returns
    -------
    array of float64
        cm2/g, in the shape of ``energies_kev``.

    Raises
    ------
    ValueError
        For an unknown material (close names are suggested), fractions that do not add up to 1, or an energy
        outside the tables.
    """
    energies = require_energies("energies_kev", energies_kev)
    flat = _mixture_attenuation(composition(material), energies.tobytes())
    return flat.reshape(energies.shape).copy()


def density(material: str) -> float:
    """Nominal density in g/cm3 of an element or a named material; other formulas have none."""
    if not isinstance(material, str):
        raise fail("material", "a name or a formula", repr(material), error=TypeError)
    name = _canonical(material)
    if name in NAMED:
        return NAMED[name][0]
    import xraydb

    symbol = _element_symbols().get(name)
    if symbol is not None:
        return float(xraydb.atomic_density(symbol))
    known = xraydb.get_material(material) or xraydb.get_material(name)
    if known is not None:
        return float(known[1])
    for value, definition in NAMED.values():
        if definition == material:
            return value
    composition(material)  # an unknown name is a different mistake from a formula without a density
    raise fail("material", "one with a known density", repr(material), "give (cm, g/cm3) instead of cm")


def known_density(material: MaterialLike) -> float | None:
    """Nominal density in g/cm3 of a material, also as the only part of a mixture, or None where `density` has none."""
    if not isinstance(material, str):
        if len(material) != 1:
            return None
        (material,) = material
    try:
        return density(material)
    except ValueError:
        return None


def require_energies(argument: str, energies_kev: Any) -> np.ndarray:
    """Energies as float64, all within the range of the tables."""
    energies = require_array(argument, energies_kev).astype(np.float64)
    low, high = ENERGY_RANGE_KEV
    if not np.all((energies >= low) & (energies <= high)):  # False for NaN as well
        extremes = f"{np.min(energies):g} to {np.max(energies):g}"
        raise fail(argument, f"keV between {low:g} and {high:g}", extremes, "divide by 1000 if these are eV")
    return energies


def composition(material: MaterialLike) -> tuple[tuple[str, float], ...]:
    """Mass fractions by element symbol, in a fixed order and adding up to 1."""
    if isinstance(material, str):
        return _composition_of_name(material)
    if not isinstance(material, Mapping):
        raise fail("material", "a name, a formula or mass fractions", repr(material), error=TypeError)
    for part in material:
        if not isinstance(part, str):
            raise fail("material", "mass fractions by element symbol or name", repr(part), error=TypeError)
    fractions = {
        part: require_number(f"mass fraction of {part}", f, at_least=0.0) for part, f in material.items()
    }
    total = sum(fractions.values())
    if abs(total - 1.0) > _FRACTION_TOLERANCE:
        raise fail("material", "mass fractions that add up to 1", f"{total:g}")
    elements: dict[str, float] = {}
    for part, fraction in fractions.items():
        for symbol, share in _composition_of_name(part):
            elements[symbol] = elements.get(symbol, 0.0) + share * fraction / total
    return tuple(sorted(elements.items()))


@lru_cache(maxsize=256)
def _composition_of_name(material: str) -> tuple[tuple[str, float], ...]:
    import xraydb

    name = _canonical(material)
    if name in NAMED:
        definition = NAMED[name][1]
        return _composition_of_formula(definition) if isinstance(definition, str) else composition(definition)
    symbol = _element_symbols().get(name)
    if symbol is not None:
        return ((symbol, 1.0),)
    known = xraydb.get_material(material) or xraydb.get_material(name)
    try:
        return _composition_of_formula(known[0] if known else material.strip())
    except ValueError:
        expected = "an element, a formula or a known mixture"
        raise fail("material", expected, repr(material), _suggestion(name)) from None


def _composition_of_formula(formula: str) -> tuple[tuple[str, float], ...]:
    import xraydb

    masses = {
        symbol: n * float(xraydb.atomic_mass(symbol)) for symbol, n in xraydb.chemparse(formula).items()
    }
    total = sum(masses.values())
    if not total > 0:
        raise ValueError(f"the formula {formula!r} has no atoms")
    return tuple(sorted((symbol, mass / total) for symbol, mass in masses.items()))


def _canonical(material: str) -> str:
    name = " ".join(material.lower().replace("_", " ").replace("-", " ").split())
    # A symbol or formula is case-sensitive ("Co" is cobalt, "CO" a gas), so only longer words are names.
    name = ALIASES.get(name, name)
    return name if name in NAMED or name in _element_symbols() else material.strip()


@lru_cache(maxsize=1)
def _element_symbols() -> dict[str, str]:
    """Symbol by symbol and by lower-case name."""
    import xraydb

    symbols = {z: str(xraydb.atomic_symbol(z)) for z in range(1, _HEAVIEST + 1)}
    names = {str(xraydb.atomic_name(z)).lower(): symbol for z, symbol in symbols.items()}
    return names | {symbol: symbol for symbol in symbols.values()}


def _suggestion(name: str) -> str:
    import xraydb

    if name.capitalize() in _element_symbols():
        return f"did you mean {name.capitalize()}?"
    known = sorted({*NAMED, *ALIASES, *_element_symbols(), *xraydb.get_materials()})
    return did_you_mean(name, known) or "element symbols are case-sensitive, as in ZrO2"


@lru_cache(maxsize=64)
def _mixture_attenuation(fractions: tuple[tuple[str, float], ...], energies: bytes) -> np.ndarray:
    import xraydb

    electronvolts = 1000.0 * np.frombuffer(energies, np.float64)
    total = np.zeros_like(electronvolts)
    for symbol, fraction in fractions if electronvolts.size else ():
        total += fraction * xraydb.mu_elam(symbol, electronvolts)
    return total

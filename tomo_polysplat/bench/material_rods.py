"""Rods of a material in water, reconstructed with the default curves and with their own."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomo_polysplat.bench.accuracy_measures import Regions, accuracy_errors
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.materials import MaterialLike, composition, density, mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.reconstruction import reconstruct
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.orbit import circular_orbit
from tomo_polysplat.simulate.phantom import Part, Phantom
from tomo_polysplat.simulate.scanner import Scanner
from tomo_polysplat.simulate.scenes import scan_phantom
from tomo_polysplat.simulate.shapes import cylinder

__all__ = ["RODS", "rod_errors", "rod_scan"]

Record = dict[str, Any]

_IODINE_WATER: MaterialLike = {"water": 0.97, "I": 0.03}
_BARIUM_WATER: MaterialLike = {"water": 0.8, "BaSO4": 0.2}
# Name, what it is made of, g/cm3, and the curves to name for it, if the default ones do not hold it.
RODS: dict[str, tuple[MaterialLike, float, tuple[MaterialLike, ...]]] = {
    "bone": ("bone", density("bone"), ()),
    "iron": ("iron", density("iron"), ()),
    **{
        metal: (metal, density(metal), ("water", "aluminium", metal))
        for metal in ("titanium", "copper", "silver", "tungsten", "gold", "lead", "iodine", "barium")
    },
    # Half of the dense curve's content in the middle one: every dilution is then on the curve.
    "iodine, 3 % in water": (_IODINE_WATER, 1.02, ("water", {"water": 0.985, "I": 0.015}, _IODINE_WATER)),
    "barium sulphate, 20 % in water": (
        _BARIUM_WATER,
        1.18,
        ("water", {"water": 0.9, "BaSO4": 0.1}, _BARIUM_WATER),
    ),
}

# In half widths of the volume: a rod is 7.6 voxels thick where the volume is 40 wide.
_WATER, _ROD, _APART = (0.85, 0.7), (0.19, 0.45), 0.42
# The object is as large as lets this P through one rod, so that the one behind the other still passes light, and at
# most as large as on a bench.
_THROUGH, _LARGEST = 2.5, 2.0


def rod_scan(name: str, spectrum: Spectrum, size: int, views: int, seed: int = 0) -> Scan:
    """Two rods of one of ``RODS`` in a cylinder of water, 1e5 photons, in a cone beam."""
    material, grams, _ = RODS[name]
    half = _half_width(material, grams, spectrum)
    radius, length = (half * part for part in _ROD)
    formula = _formula(material)
    parts = [Part(cylinder((0, 0, 0), half * _WATER[0], half * _WATER[1]), "water", 1.0)]
    for side, lean in ((-1, 0.0), (1, 0.1)):
        shape = cylinder((side * half * _APART, 0, 0), radius, length, (0.5 * lean, lean, 1.0))
        parts.append(Part(shape, formula, grams, metal=True))
    pixels = -(-3 * size // 2)
    angles = 2 * np.pi * np.arange(views) / views
    geometries = circular_orbit("cone", half, size, pixels, pixels, angles)
    return scan_phantom(Phantom(parts), *geometries, spectrum, Scanner(seed=seed), name=f"rods of {name}")


def _half_width(material: MaterialLike, grams: float, spectrum: Spectrum) -> float:
    """Half the edge of the volume in cm."""
    lit = spectrum.weights > 0
    curve = grams * mass_attenuation(material, spectrum.energies[lit])[None]
    paths = np.geomspace(1e-5, 2 * _ROD[0] * _LARGEST, 400)
    through = projection(paths[None], np.log(spectrum.weights[lit]), curve)
    return float(np.interp(_THROUGH, through, paths)) / (2 * _ROD[0])


def _formula(material: MaterialLike) -> str:
    """Moles of each element, as a phantom's materials are told by name or formula."""
    import xraydb

    if isinstance(material, str):
        return material
    return "".join(
        f"{symbol}{share / xraydb.atomic_mass(symbol):.9f}" for symbol, share in composition(material)
    )


def rod_errors(
    scan: Scan, materials: tuple[MaterialLike, ...], device: str, quality: str = "balanced"
) -> Record:
    """The errors of ``bench.accuracy_measures.accuracy_errors`` with these curves, or with the default ones for ()."""
    assert scan.truth is not None
    result = reconstruct(
        scan.projections,
        scan.proj_geom,
        scan.vol_geom,
        spectrum=scan.spectrum,
        materials=materials or None,
        unit=scan.unit,
        valid=scan.valid,
        quality=quality,
        device=device,
        progress=False,
    )
    errors = accuracy_errors(Regions.of(scan.truth, scan.metal_mask), result.volume, scan)
    return {**errors, "agent": result.plan["agent"].why}

"""Objects at the limits: nothing, everything, and metals of all kinds."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomo_polysplat.bench.hard_cases.case import Case, Findings
from tomo_polysplat.bench.hard_cases.easy import (
    PASSES,
    SPREAD_OF_A_SLICE,
    explains,
    fit,
    metal_pin,
    mono_slice,
    orbit,
    psnr_of,
    scan_of,
    sirt_psnr,
    soft_slice,
    sound,
)
from tomo_polysplat.physics.materials import density
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import Geometry, from_astra, projections_from_astra
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.phantom import Part
from tomo_polysplat.simulate.shapes import box
from tomo_polysplat.start.sirt import sirt

__all__ = ["CASES"]

_VOXEL = 5.0 / 32


def _empty(device: str) -> Findings:
    result = fit(soft_slice(), device, np.zeros_like(soft_slice().projections))
    findings = sound(result)
    findings.at_most("largest value", float(result.volume.max()), 0.0)
    findings.equal("Gaussians", result.counts["gaussians"], 0)
    return findings


def _uniform(device: str) -> Findings:
    """Every ray alike, those beside the window too: what is fitted explains more of them than a volume can."""
    easy = mono_slice()
    values = np.ones_like(easy.projections)
    scan = Scan(values, easy.proj_geom, easy.vol_geom, spectrum=easy.spectrum)
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    result = fit(scan, device)
    classical = sirt(projections_from_astra(values, scan.proj_geom), geometry, grid, passes=50)
    findings = sound(result)
    left = _line_integrals(result, geometry) - projections_from_astra(values, scan.proj_geom)
    findings.at_most("rms of P left", float(np.sqrt(np.mean(left**2))), explains(classical, scan))
    told = "the object reaches beyond the detector and the volume" in result.plan["window"].why
    findings.equal("what lies beside the window is told", told, True)
    return findings


def _line_integrals(result: Result, geometry: Geometry) -> np.ndarray:
    """(views, 1, columns) integrals of planar Gaussians along the rays of a fan, in closed form."""
    parts = result.gaussians
    w, z = parts["rotation"][:, 0], parts["rotation"][:, 3]
    cosine, sine = 1 - 2 * z**2, 2 * w * z
    axes = np.stack([np.stack([cosine, sine], 1), np.stack([-sine, cosine], 1)], 1)
    # Whitened: the axes of each Gaussian over its deviations.
    axes = axes / parts["scale"][:, :2, None]
    images = []
    for source, corner, u in zip(geometry.origin, geometry.corner, geometry.u):
        ray = (corner + np.arange(geometry.columns)[:, None] * u - source)[:, :2]
        ray /= np.linalg.norm(ray, axis=1, keepdims=True)
        along = np.einsum("nij,rj->rni", axes, ray)
        away = np.einsum("nij,nj->ni", axes, parts["position"][:, :2] - source[:2])
        square = (along**2).sum(axis=-1)
        missed = (along[..., 0] * away[:, 1] - along[..., 1] * away[:, 0]) ** 2 / square
        weight = parts["density"] * np.sqrt(2 * np.pi / square)
        images.append((weight * np.exp(-0.5 * missed)).sum(axis=1))
    return np.stack(images)[:, None]


def _metal(
    device: str, *pins: Part, mass: float | None = 0.25, **changes: Any
) -> tuple[Scan, Result, Findings]:
    """Outside metal no worse than SIRT; the mass of each pin within ``mass``."""
    scan = scan_of(*orbit(), *pins)
    result = fit(scan, device, **changes)
    findings = sound(result, rays_marked_invalid=scan.notes["starved_rays"])
    findings.at_least(
        "PSNR without metal, dB", psnr_of(result.volume, scan), sirt_psnr(scan) - SPREAD_OF_A_SLICE
    )
    for pin in pins:
        if mass is None:
            break
        found, true = (_around(volume, pin) for volume in (result.volume, scan.truth))
        findings.at_most(f"error of the mass of {pin.material}", abs(found / true - 1), mass)
    return scan, result, findings


def _around(volume: np.ndarray | None, pin: Part) -> float:
    """Sum over the voxels within two of a pin."""
    assert volume is not None
    y, x = (np.mgrid[:32, :32] - 15.5) * _VOXEL
    reach = pin.shape.semi[0] + 2 * _VOXEL
    return float(volume[0][np.hypot(x - pin.shape.centre[0], y - pin.shape.centre[1]) < reach].sum())


def _at_edge(device: str) -> Findings:
    return _metal(device, metal_pin(centre=(2.27, 0.0, 0.0)))[2]


def _one_voxel(device: str) -> Findings:
    centre = (np.array([12.0, 20.0, 15.5]) - 15.5) * _VOXEL
    # A little less than the voxel, whose neighbours' samples would else lie on its faces.
    iron = Part(box(centre, 0.49 * _VOXEL), "iron", 7.87, metal=True)
    # After five passes its mass is still on its way: as many as by default.
    return _metal(device, iron, settings={"passes": 2 * PASSES})[2]


def _lead(device: str) -> Findings:
    scan, _, findings = _metal(device, metal_pin("lead", density("lead"), radius=0.5), mass=None)
    findings.at_least("rays without light", scan.notes["starved_rays"], 100)
    return findings


def _two(device: str) -> Findings:
    return _metal(device, metal_pin(), metal_pin("titanium", density("titanium"), (0.9, -0.6, 0.0), 0.25))[2]


def _edge(material: str, named: bool, device: str) -> Findings:
    """A thin solution of an element whose K edge lies inside the spectrum, on the default curves or named."""
    pin = metal_pin(material, 0.15, radius=0.5)
    changes = {"materials": ("water", "aluminium", material)} if named else {}
    return _metal(device, pin, mass=0.1 if named else 0.4, **changes)[2]


def _iodine(device: str) -> Findings:
    return _edge("I", False, device)


def _iodine_named(device: str) -> Findings:
    return _edge("I", True, device)


def _barium_named(device: str) -> Findings:
    return _edge("BaSO4", True, device)


_METAL = "outside metal SIRT less the spread of seeds; the metal's mass within 25 %"
CASES = (
    Case("empty", "a scan of zeros is a volume of zeros", _empty),
    Case(
        "uniform",
        "every ray 1, beside the window too: no worse than SIRT, which has the window only",
        _uniform,
    ),
    Case("metal-at-edge", f"touching the edge of the window: {_METAL}", _at_edge),
    Case("metal-one-voxel", f"iron in one voxel: {_METAL}", _one_voxel),
    Case("lead", "1 cm of lead, no light behind it: outside metal SIRT less the spread of seeds", _lead),
    Case("two-metals", f"iron and titanium: {_METAL}", _two),
    Case("iodine", "on the default curves: 40 %", _iodine),
    Case("iodine-named", "named as a material: 10 %", _iodine_named),
    Case("barium-named", "named as a material: 10 %", _barium_named),
)

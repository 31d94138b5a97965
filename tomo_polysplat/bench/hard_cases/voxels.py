"""Volumes of odd shapes, in odd units, far from the origin."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomo_polysplat.bench.hard_cases.case import Case, Findings
from tomo_polysplat.bench.hard_cases.easy import (
    HALF,
    PASSES,
    SPREAD,
    SPREAD_OF_A_SLICE,
    fit,
    mono_slice,
    orbit,
    psnr_of,
    scan_of,
    sirt_psnr,
    soft_slice,
    sound,
)
from tomo_polysplat.bench.hard_cases.same import same_volume
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import from_astra, to_astra
from tomo_polysplat.scan.scan import Scan

__all__ = ["CASES"]

# Coordinates in another unit differ in their last bits.
_ROUNDING = 1e-3
# Of the object, whose Gaussians may reach a little beyond the window.
_MASS = 0.05


def _cone(shape: tuple[int, int, int], half_height: float = HALF) -> Scan:
    """The cone scan with a volume of (z, y, x) voxels, or a part of its height."""
    proj_geom, vol_geom = orbit("cone", 24, 40)
    counts = dict(zip(("GridSliceCount", "GridRowCount", "GridColCount"), shape))
    window = {"WindowMinZ": -half_height, "WindowMaxZ": half_height}
    return scan_of(proj_geom, vol_geom | counts | {"option": vol_geom["option"] | window})


def _primes(device: str) -> Findings:
    """The easy case's voxels, 23 x 19 x 17 of them."""
    proj_geom, vol_geom = orbit("cone", 24, 40)
    counts = {"X": 23, "Y": 19, "Z": 17}
    edge = 2 * HALF / 24
    window = {f"WindowMin{axis}": -0.5 * n * edge for axis, n in counts.items()}
    window |= {f"WindowMax{axis}": 0.5 * n * edge for axis, n in counts.items()}
    names = {"X": "GridColCount", "Y": "GridRowCount", "Z": "GridSliceCount"}
    grid = {names[axis]: n for axis, n in counts.items()} | {"option": vol_geom["option"] | window}
    scan = scan_of(proj_geom, vol_geom | grid)
    result = fit(scan, device)
    findings = sound(result)
    findings.equal("shape", list(result.volume.shape), [17, 19, 23])
    findings.at_least("PSNR, dB", psnr_of(result.volume, scan), sirt_psnr(scan) - SPREAD)
    return findings


def _large_voxels(
    shape: tuple[int, int, int], half_height: float, device: str
) -> tuple[Scan, Result, Findings]:
    """A scan whose truth is the mean of finer voxels, and its reconstruction."""
    fine = _cone((20 if shape[0] == 5 else 16, 25, 25) if shape[1] > 1 else (24, 24, 24), half_height)
    scan = _cone(shape, half_height)
    assert fine.truth is not None
    blocks = [n for pair in zip(shape, np.array(fine.truth.shape) // shape) for n in pair]
    scan.truth = fine.truth.reshape(blocks).mean(axis=(1, 3, 5))
    scan.metal_mask = np.zeros(shape, bool)
    # The passes of a balanced run: what is inside a voxel the start does not show.
    result = fit(scan, device, settings={"passes": 2 * PASSES})
    findings = sound(result)
    findings.equal("shape", list(result.volume.shape), list(shape))
    findings.at_most("error of the mass", abs(float(result.volume.sum() / scan.truth.sum()) - 1), _MASS)
    return scan, result, findings


def _flat(device: str) -> Findings:
    scan, result, findings = _large_voxels((5, 25, 25), HALF, device)
    findings.at_least("PSNR, dB", psnr_of(result.volume, scan), sirt_psnr(scan) - SPREAD)
    return findings


def _one_slice(device: str) -> Findings:
    """A slice as high as the object: everything that is measured belongs to it."""
    scan, result, findings = _large_voxels((1, 25, 25), 1.6, device)
    findings.at_least("PSNR, dB", psnr_of(result.volume, scan), sirt_psnr(scan) - SPREAD_OF_A_SLICE)
    return findings


def _one_voxel(device: str) -> Findings:
    return _large_voxels((1, 1, 1), HALF, device)[2]


def _moved(scan: Scan, factor: float, offset: float) -> tuple[dict[str, Any], dict[str, Any]]:
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    by = offset * np.array([1.0, -1.0, 1.0])
    return to_astra(geometry.scaled(factor).shifted(by), grid.scaled(factor).shifted(by))


def _elsewhere(scan: Scan, factor: float, offset: float, device: str) -> Findings:
    proj_geom, vol_geom = _moved(scan, factor, offset)
    result = fit(scan, device, proj_geom=proj_geom, vol_geom=vol_geom)
    findings, easy = sound(result), fit(scan, device).volume
    same_volume(findings, result.volume * factor, easy, device, "volume at the origin in cm", _ROUNDING)
    return findings


def _small(device: str) -> Findings:
    return _elsewhere(mono_slice(), 1e-6, 0.0, device)


def _large(device: str) -> Findings:
    return _elsewhere(mono_slice(), 1e6, 0.0, device)


def _offset(device: str) -> Findings:
    return _elsewhere(soft_slice(), 1.0, 1e3 * 2 * HALF, device)


_UNIT = "physics knows no unit and no origin; coordinates round"
_LARGE = "the mass within 5 %; SIRT less the spread of seeds"
CASES = (
    Case("flat-voxels", f"voxels 1:5: {_LARGE}", _flat),
    Case("odd-primes", "23 x 19 x 17 of the easy case's voxels: SIRT less the spread of seeds", _primes),
    Case("one-slice", f"25 x 25 x 1 voxels of a cone beam: {_LARGE}", _one_slice),
    Case("one-voxel", "the mass of all that is there, within 5 %", _one_voxel),
    Case("scale-1e-6", f"lengths times 1e-6: {_UNIT}", _small),
    Case("scale-1e6", f"lengths times 1e6: {_UNIT}", _large),
    Case("offset-1000", f"1000 volumes off the origin: {_UNIT}", _offset),
)

"""Scanners at the limits: truncated, far, near, tilted, with oblong pixels."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from tomo_polysplat.bench.hard_cases.case import Case, Findings, refused
from tomo_polysplat.bench.hard_cases.easy import (
    SPREAD,
    SPREAD_OF_A_SLICE,
    easy_psnr,
    fit,
    orbit,
    psnr_in,
    psnr_of,
    rays_lost,
    scan_of,
    sirt_psnr,
    soft_slice,
    sound,
)
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.orbit import view_vectors
from tomo_polysplat.simulate.scanner import Scanner

__all__ = ["CASES"]


def _columns(scan: Scan, first: int, last: int) -> tuple[np.ndarray, dict[str, Any]]:
    """The projections and geometry of part of the detector."""
    vectors = scan.proj_geom["Vectors"].copy()
    vectors[:, 3:6] += (0.5 * (first + last - 1) - 0.5 * (scan.columns - 1)) * vectors[:, 6:9]
    geometry = scan.proj_geom | {"DetectorColCount": last - first, "Vectors": vectors}
    return scan.projections[:, :, first:last], geometry


def _truncated(device: str) -> Findings:
    """The middle 28 of 48 columns see a circle of 1.5 cm of an object of 1.9 cm."""
    scan = soft_slice()
    values, proj_geom = _columns(scan, 10, 38)
    result = fit(scan, device, values, proj_geom=proj_geom)
    y, x = (np.mgrid[:32, :32] - 15.5) * (5.0 / 32)
    seen = (np.hypot(x, y) < 1.3)[None]
    findings = sound(result)
    classical = sirt_psnr(scan, seen, projections=values, proj_geom=proj_geom)
    findings.at_least(
        "PSNR of what is seen, dB", psnr_in(result.volume, scan, seen), classical - SPREAD_OF_A_SLICE
    )
    return findings


def _half_fan(device: str) -> Findings:
    """30 of 48 columns, all of one side: a full turn still sees every line once."""
    scan = soft_slice()
    values, proj_geom = _columns(scan, 18, 48)
    result = fit(scan, device, values, proj_geom=proj_geom)
    findings = sound(result)
    loss = easy_psnr("slice", device) - psnr_of(result.volume, scan)
    findings.at_most("PSNR lost, dB", loss, rays_lost(18 / 48) + SPREAD_OF_A_SLICE)
    return findings


def _source_far(device: str) -> Findings:
    """A source a million radii away is a parallel beam."""
    parallel, vol_geom = orbit("parallel")
    parallel |= {"DetectorRowCount": 1}
    vol_geom = soft_slice().vol_geom
    far = parallel | {"type": "cone", "DistanceOriginSource": 2.5e6, "DistanceOriginDetector": 2.5}
    found = []
    for proj_geom in (parallel, far):
        scan = scan_of(proj_geom, vol_geom)
        result = fit(scan, device)
        found.append((psnr_of(result.volume, scan), result))
    findings = sound(found[1][1])
    findings.at_most("PSNR lost to a parallel beam, dB", found[0][0] - found[1][0], SPREAD_OF_A_SLICE)
    return findings


def _near(distance: float) -> Scan:
    """A fan of 144 degrees from a source at so many radii of the object, which reaches 2 cm from the axis."""
    source, count = 2.0 * distance, 144
    half = (source + 2.0) * 3.4
    angle = 2 * np.pi * np.arange(60) / 60
    out = np.stack([np.sin(angle), -np.cos(angle), 0 * angle], 1)
    across = np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1)
    up = np.broadcast_to([0.0, 0.0, 1.0], out.shape)
    pixel = 2 * half / count
    vectors = np.hstack([source * out, -2.0 * out, pixel * across, pixel * up])
    proj_geom = {"type": "cone_vec", "DetectorRowCount": 1, "DetectorColCount": count, "Vectors": vectors}
    window = {f"Window{end}{axis}": sign * 2.03 for end, sign in (("Min", -1), ("Max", 1)) for axis in "XY"}
    height = {"WindowMinZ": -2.03 / 32, "WindowMaxZ": 2.03 / 32}
    vol_geom = {"GridRowCount": 32, "GridColCount": 32, "GridSliceCount": 1, "option": window | height}
    return scan_of(proj_geom, vol_geom, scanner=Scanner(1e5))


def _source_near(device: str) -> Findings:
    scan = _near(1.05)
    result = fit(scan, device)
    findings = sound(result)
    findings.at_least("PSNR, dB", psnr_of(result.volume, scan), sirt_psnr(scan) - SPREAD_OF_A_SLICE)
    findings.equal("what is left out is told", "beyond the sources" in result.plan["start"].value, True)
    return findings


def _source_inside(device: str) -> Findings:
    scan = _near(0.95)
    return refused(lambda **progress: fit(scan, device, **progress), ValueError, "source positions")


def _vectors(proj_geom: dict[str, Any], degrees: float = 0.0) -> dict[str, Any]:
    """The cone as vectors, its detector turned about its rows through its centre."""
    _, vectors = view_vectors(proj_geom)
    source, corner, u, v = np.moveaxis(vectors, 1, 0)
    rows, columns = proj_geom["DetectorRowCount"], proj_geom["DetectorColCount"]
    centre = corner + 0.5 * (columns - 1) * u + 0.5 * (rows - 1) * v
    away = centre / np.linalg.norm(centre, axis=1, keepdims=True) * np.linalg.norm(v, axis=1, keepdims=True)
    angle = math.radians(degrees)
    turned = math.cos(angle) * v + math.sin(angle) * away
    kept = {"DetectorRowCount": rows, "DetectorColCount": columns}
    return {"type": "cone_vec", **kept, "Vectors": np.hstack([source, centre, u, turned])}


def _tilted(device: str) -> Findings:
    proj_geom, vol_geom = orbit("cone", 24, 40)
    scan = scan_of(_vectors(proj_geom, 20.0), vol_geom)
    result = fit(scan, device)
    findings = sound(result)
    loss = easy_psnr("cone", device) - psnr_of(result.volume, scan)
    findings.at_most("PSNR lost, dB", loss, SPREAD - 20 * math.log10(math.cos(math.radians(20))))
    return findings


def _flat_pixels(device: str) -> Findings:
    proj_geom, vol_geom = orbit("cone", 24, 40)
    proj_geom |= {"DetectorRowCount": 9, "DetectorSpacingY": 4 * proj_geom["DetectorSpacingY"]}
    scan = scan_of(proj_geom, vol_geom)
    result = fit(scan, device)
    findings = sound(result)
    findings.at_least("PSNR, dB", psnr_of(result.volume, scan), sirt_psnr(scan) - SPREAD)
    return findings


_SIRT = "no worse than SIRT on the same rays, less the spread of seeds"
CASES = (
    Case("truncated", f"the detector sees 1.5 of 1.9 cm: {_SIRT}, where it sees", _truncated),
    Case("half-fan", "30 of 48 columns: noise of fewer rays and the spread of seeds", _half_fan),
    Case("source-far", "1e6 radii: the parallel beam less the spread of seeds", _source_far),
    Case("source-near", f"1.05 radii of the object: {_SIRT}", _source_near),
    Case("source-inside", "rays that start in the object are an error", _source_inside),
    Case("tilt-20", "the easy case less the spread of seeds and 1 / cos 20 in sampling", _tilted),
    Case("flat-pixels", f"pixels 1:4: {_SIRT}", _flat_pixels),
)

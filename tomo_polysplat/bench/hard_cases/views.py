"""Few views, part of an arc, views out of order, and a centre of rotation that is off."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomo_polysplat.bench.hard_cases.case import Case, Findings
from tomo_polysplat.bench.hard_cases.easy import (
    PASSES,
    SPREAD,
    SPREAD_OF_A_SLICE,
    easy_psnr,
    explains,
    fit,
    orbit,
    psnr_of,
    scan_of,
    sirt_psnr,
    soft_cone,
    soft_slice,
    sound,
    tube,
)
from tomo_polysplat.bench.hard_cases.same import same_volume
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.settings import Settings
from tomo_polysplat.simulate.orbit import circular_orbit

__all__ = ["CASES"]

# A pass over a few views is a few steps: as many in all as a balanced run of the easy case makes.
_STEPS, _VIEWS_PER_STEP = 150, 4


def _few(scan: Scan, device: str) -> Findings:
    """Explained as the truth on the same voxels explains it, to the error of P that the loss forgives."""
    assert scan.truth is not None
    # Below ten views a pass makes the steps of one over ten.
    settings = {"passes": float(_STEPS * min(scan.views, _VIEWS_PER_STEP) / max(scan.views, 10))}
    result = fit(scan, device, settings=settings)
    findings = sound(result)
    findings.at_most(
        "rms of P left", explains(result.volume, scan), explains(scan.truth, scan) + Settings().model_error
    )
    findings.at_least("PSNR, dB", psnr_of(result.volume, scan), sirt_psnr(scan) - SPREAD_OF_A_SLICE)
    return findings


def _mono(views: int, degrees: float) -> Scan:
    """One energy, so that a volume's projections can be compared with the rays."""
    angles = np.deg2rad(degrees) * np.arange(views) / views
    geometries = circular_orbit("fan", 2.5, 32, 48, 48, angles)
    return scan_of(*geometries, spectrum=Spectrum.monochromatic(60.0))


def _one_view(device: str) -> Findings:
    return _few(_mono(1, 360.0), device)


def _two_views(device: str) -> Findings:
    return _few(_mono(2, 180.0), device)


def _eight_views(device: str) -> Findings:
    return _few(_mono(8, 360.0), device)


def _arc(device: str) -> Findings:
    return _few(_mono(40, 60.0), device)


def _in_order(order: np.ndarray, device: str, **changes: Any) -> Result:
    """A fit of the volume with its views in another order."""
    scan = soft_cone()
    proj_geom = scan.proj_geom | {"ProjectionAngles": scan.proj_geom["ProjectionAngles"][order]}
    return fit(scan, device, scan.projections[:, order], proj_geom=proj_geom, **changes)


def _unsorted(device: str) -> Findings:
    """The same rays: not only as good a volume, but the same."""
    views = np.arange(soft_cone().views)
    result = _in_order(np.random.default_rng(0).permutation(views), device)
    findings, easy = sound(result), _in_order(views, device)
    same_volume(findings, result.volume, easy.volume, device, "volume of sorted views")
    return findings


def _duplicated(device: str) -> Findings:
    """As many steps as ever."""
    result = _in_order(np.repeat(np.arange(soft_cone().views), 2), device, settings={"passes": PASSES / 2})
    findings = sound(result)
    loss = easy_psnr("cone", device) - psnr_of(result.volume, soft_cone())
    findings.at_most("PSNR lost, dB", loss, SPREAD)
    return findings


def _shifted(proj_geom: dict[str, Any], pixels: float) -> dict[str, Any]:
    """The detector moved along its columns."""
    vectors = proj_geom["Vectors"].copy()
    vectors[:, 3:6] += pixels * vectors[:, 6:9]
    return proj_geom | {"Vectors": vectors}


def _centre_told(device: str) -> Findings:
    proj_geom, vol_geom = orbit()
    scan = scan_of(_shifted(proj_geom, 0.5), vol_geom)
    result = fit(scan, device)
    findings = sound(result)
    loss = easy_psnr("slice", device) - psnr_of(result.volume, scan)
    findings.at_most("PSNR lost, dB", loss, SPREAD_OF_A_SLICE)
    return findings


def _centre_wrong(device: str) -> Findings:
    scan = soft_slice()
    wrong = _shifted(scan.proj_geom, 0.5)
    result = fit(scan, device, proj_geom=wrong)
    findings = sound(result)
    reached = sirt_psnr(scan, proj_geom=wrong, spectrum=tube())
    findings.at_least("PSNR, dB", psnr_of(result.volume, scan), reached - SPREAD_OF_A_SLICE)
    return findings


_RAYS = "rays explained as by the true voxels, to the error the fit allows; SIRT less the spread of seeds"
_SAME = "the same information: the easy case less the spread of seeds"
CASES = (
    Case("one-view", _RAYS, _one_view),
    Case("two-views", _RAYS, _two_views),
    Case("eight-views", _RAYS, _eight_views),
    Case("arc-60", f"60 degrees of arc: {_RAYS}", _arc),
    Case("unsorted", "views in random order: the same volume, bit by bit on a CPU", _unsorted),
    Case("duplicated", f"every view twice: {_SAME}", _duplicated),
    Case("centre-told", f"axis off by half a pixel, as the geometry says: {_SAME}", _centre_told),
    Case("centre-wrong", "axis off by half a pixel, unknown: SIRT that knows no better", _centre_wrong),
)

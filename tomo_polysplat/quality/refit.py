"""A result's fit made again on other rays, with every decision as it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, NamedTuple

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.plan.answer import Status
from tomo_polysplat.reconstruction import reconstruct
from tomo_polysplat.result.filter_found import filter_of
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.flattened import flattened
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.scan.volume_grid import VolumeGrid
from tomo_polysplat.settings import Settings

__all__ = ["Levels", "fit_again", "geometry_of", "levels_of", "require_scan_of", "settings_of", "voxel_edge"]

# Decisions whose answer is no setting of that kind, or which the number of views or rays may change.
_FREE = ("tv_corner", "agent", "gains", "drift", "beam")


class Levels(NamedTuple):
    """Attenuation in 1/unit at the result's energy: of the object's main matter, and from where on there is metal."""

    soft: float
    metal: float


def levels_of(result: Result) -> Levels:
    """Levels of a result, by its plan, else by its volume."""
    metal = float(result.settings.get("metal_level", Settings().metal_level))
    if "soft_reference" in result.plan:
        soft = float(result.plan["soft_reference"].value["first"])
        if result.materials is not None and result.energy_kev is not None:
            from tomo_polysplat.units import cm_per

            soft *= float(result.materials.mass_attenuation([result.energy_kev])[0, 0]) * cm_per(result.unit)
    else:
        volume = result.volume
        soft = float(np.median(volume[volume > 0.1 * np.quantile(volume, 0.99)], overwrite_input=True))
    return Levels(soft, metal * soft)


def settings_of(result: Result) -> dict[str, Any]:
    """The settings that a result was made with, with what its plan decided, so that nothing is asked again."""
    known = {field.name for field in fields(Settings)}
    chosen = {name: value for name, value in result.settings.items() if name in known}
    for name, answer in result.plan.items():
        decided = name in known and name not in _FREE and answer.status is not Status.FOUND
        if decided and chosen.get(name) is None:
            chosen[name] = answer.value
    return chosen


def require_scan_of(result: Result, scan: Scan) -> None:
    """Raise ValueError unless the result was fitted, and the scan has its volume and unit."""
    if not result.gaussians:
        raise fail(
            "result", "one that Gaussians were fitted for", "a volume without any", "reconstruct makes one"
        )
    if scan.unit != result.unit:
        raise fail("scan", f"the scan of the result, in {result.unit}", f"one in {scan.unit}")
    if scan.volume_shape != result.grid.shape:
        raise fail("scan", f"the scan of the result, {result.grid.shape}", f"a volume of {scan.volume_shape}")


def geometry_of(result: Result, scan: Scan) -> Mapping[str, Any]:
    """ASTRA's geometry of the projections as the result was made with it: moved where that was found."""
    moved = any(name in result.plan and result.plan[name].value for name in ("alignment", "mended"))
    return result.geometry if moved and result.geometry is not None else scan.proj_geom


def voxel_edge(grid: VolumeGrid) -> float:
    """Longest edge of a voxel, in a slice within its plane."""
    return float(max(edge for edge, n in zip(grid.voxel_size, grid.shape[::-1]) if n > 1))


def fit_again(
    result: Result,
    scan: Scan,
    *,
    projections: np.ndarray | None = None,
    views: np.ndarray | None = None,
    device: str = "auto",
    progress: Any = None,
) -> np.ndarray:
    """(z, y, x) volume of a fit of other ``projections``, of some ``views``, or both, else as the result was made."""
    scan = flattened(scan)
    proj_geom = geometry_of(result, scan)
    values = scan.projections if projections is None else projections
    valid, spectrum = scan.usable, result.spectrum if result.materials is not None else None
    if views is not None:
        proj_geom, values = _of_views(proj_geom, views), values[:, views]
        valid = None if valid is None else valid[:, views]
    scattered = "scatter" in result.plan and bool(result.plan["scatter"].value)
    again = reconstruct(
        np.ascontiguousarray(values),
        proj_geom,
        scan.vol_geom,
        spectrum=spectrum,
        materials=result.materials,
        unit=scan.unit,
        valid=valid,
        water_correction=scan.water_correction if spectrum is not None else None,
        filter_map=filter_of(result, scan),
        calibrate="scatter" if scattered and spectrum is not None else False,
        align=False,
        seed=int(result.settings.get("seed", 0)),
        settings=settings_of(result),
        device=device,
        progress=progress,
    )
    return again.volume_zyx


def _of_views(proj_geom: Mapping[str, Any], views: np.ndarray) -> dict[str, Any]:
    """An ASTRA geometry of some of its views."""
    name = "Vectors" if "Vectors" in proj_geom else "ProjectionAngles"
    return {**proj_geom, name: np.ascontiguousarray(np.asarray(proj_geom[name])[views])}

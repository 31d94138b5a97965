"""The ``.npz`` scan: a cone-beam scan in one NumPy archive.

``projections`` (views, rows, columns) = -log(I/I0); ``vectors`` (views, 12), ASTRA ``cone_vec`` unless
``astra_type`` says otherwise; ``vol_shape`` (nz, ny, nx);
``vol_window`` (xmin, xmax, ymin, ymax, zmin, zmax); optional ``unit`` (cm if absent), ``energies`` (keV) with
``spectrum``, ``truth_mu`` and ``metal_mask`` (z, y, x), ``e_ref`` or ``e_eff`` (keV, energy of the truth) and
``valid`` (like the projections) and ``carries_water_correction`` (coefficients of ``Scan.water_correction``; a key
``water_correction`` without "carries" is found in files whose correction was undone, and is not read); and of
``Scan.filter_map`` ``filter_thickness`` (rows, columns) in the unit, ``filter_material`` and ``filter_density``.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_shape
from tomo_polysplat.files import replacing
from tomo_polysplat.scan.archive import archived_number, archived_text, read_archive
from tomo_polysplat.scan.defects import attenuation
from tomo_polysplat.scan.layout import (
    spatial_geometry,
    vector_form,
    vector_geometry,
    volume_geometry,
    window_of,
)
from tomo_polysplat.scan.reading import ReadOptions
from tomo_polysplat.scan.scan import Scan

if TYPE_CHECKING:
    from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["scan_from_npz", "write_npz"]

# Numbers that those may have whose size does not go with the scan's.
_MOST = {
    **dict.fromkeys(("astra_type", "unit", "spectrum_label", "e_ref", "e_eff"), 1),
    **dict.fromkeys(("filter_material", "filter_density"), 1),
    "vol_shape": 3,
    "vol_window": 6,
    "carries_water_correction": 100,
    **dict.fromkeys(("energies", "spectrum"), 1_000_000),
}
# Of the longest kind of vectors, for each view.
_PER_VECTOR = 13


def scan_from_npz(path: Path, options: ReadOptions) -> Scan:
    """Read a scan; see :func:`tomo_polysplat.load_scan`."""
    options.refuse_parallel_only()
    arrays = read_archive(path, ("projections", *_MOST), _MOST)
    sizes = _sizes(arrays)
    arrays |= read_archive(path, sizes, sizes)
    missing = [name for name in ("projections", "vectors", "vol_shape", "vol_window") if name not in arrays]
    if missing:
        remedy = "a stack of pictures is read too: call its arrays projections, flats, darks and degrees"
        expected = "projections, vectors, vol_shape and vol_window"
        raise fail("path", expected, f"no {', '.join(missing)} in {path}", remedy)
    values = require_array("projections", arrays["projections"], 3)
    if options.input not in (None, "attenuation"):
        raise fail("input", "'attenuation', which an .npz scan holds", repr(options.input))
    integrals, valid, counts = attenuation(values, "attenuation")
    if "valid" in arrays:
        stored = require_array("valid", arrays["valid"])
        require_shape("valid", stored, values.shape, "(views, rows, columns)")
        valid &= stored.astype(bool)
    views, rows, columns = values.shape
    own_volume = options.vol_geom is None
    return Scan(
        projections=integrals.transpose(1, 0, 2),
        valid=None if valid.all() else valid.transpose(1, 0, 2),
        spectrum=options.spectrum or _spectrum(arrays),
        truth=arrays.get("truth_mu") if own_volume else None,
        metal_mask=arrays.get("metal_mask") if own_volume else None,
        truth_energy_kev=archived_number(arrays, "e_ref", "e_eff"),
        name=path.stem,
        water_correction=_water_correction(arrays, options),
        filter_map=_filter_map(arrays),
        notes={"input": "attenuation", "rays": counts},
        **_geometry(arrays, (rows, views, columns), options),
    )


def _sizes(arrays: dict[str, np.ndarray]) -> dict[str, int]:
    """Numbers that those may have whose size goes with the scan's."""
    shape, projections = arrays.get("vol_shape"), arrays.get("projections")
    found = {}
    if projections is not None:
        found = {
            "valid": projections.size,
            "filter_thickness": projections.size,
            "vectors": _PER_VECTOR * len(np.atleast_1d(projections)),
        }
    if shape is not None and shape.dtype.kind in "iuf":
        voxels = math.prod(int(n) for n in shape.flat if 0 < n < 2**31)
        found |= dict.fromkeys(("truth_mu", "metal_mask"), voxels)
    return found


def _geometry(
    arrays: dict[str, np.ndarray], shape: tuple[int, int, int], options: ReadOptions
) -> dict[str, Any]:
    """``proj_geom``, ``vol_geom`` and ``unit``: the caller's or the file's."""
    if options.proj_geom is not None:
        proj_geom = spatial_geometry(dict(options.proj_geom))
    else:
        proj_geom = vector_geometry(
            archived_text(arrays, "astra_type") or "cone_vec", arrays["vectors"], shape
        )
    vol_geom = dict(options.vol_geom or volume_geometry(arrays["vol_shape"], arrays["vol_window"]))
    stated = archived_text(arrays, "unit") if options.proj_geom is None else None
    return {"proj_geom": proj_geom, "vol_geom": vol_geom, "unit": options.settled_unit(stated, "cm")}


def _spectrum(arrays: dict[str, np.ndarray]) -> Spectrum | None:
    if "energies" not in arrays or "spectrum" not in arrays:
        return None
    from tomo_polysplat.physics.spectrum import Spectrum

    return Spectrum(
        arrays["energies"], arrays["spectrum"], archived_text(arrays, "spectrum_label") or "measured spectrum"
    )


def _water_correction(arrays: dict[str, np.ndarray], options: ReadOptions) -> tuple[float, ...] | None:
    if options.water_correction is not None:
        return tuple(options.water_correction)
    return tuple(arrays["carries_water_correction"]) if "carries_water_correction" in arrays else None


def _filter_map(arrays: dict[str, np.ndarray]) -> tuple[Any, ...] | None:
    material = archived_text(arrays, "filter_material")
    if material is None or "filter_thickness" not in arrays:
        return None
    thickness, density = arrays["filter_thickness"], archived_number(arrays, "filter_density")
    return (material, thickness) if density is None else (material, thickness, density)


def write_npz(scan: Scan, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a scan as ``.npz``; see the module's description for what it holds."""
    geometry = vector_form(scan.proj_geom)
    content: dict[str, Any] = {
        "projections": scan.projections.transpose(1, 0, 2),
        "astra_type": geometry["type"],
        "vectors": geometry["Vectors"],
        "vol_shape": np.array(scan.volume_shape),
        "vol_window": window_of(scan.vol_geom),
        "unit": scan.unit,
        "truth_mu": scan.truth,
        "metal_mask": scan.metal_mask,
        "e_ref": scan.truth_energy_kev,
        "carries_water_correction": scan.water_correction,
        "valid": None if scan.valid is None else scan.valid.transpose(1, 0, 2),
    }
    if scan.spectrum is not None:
        content |= {"energies": scan.spectrum.energies, "spectrum": scan.spectrum.weights}
        content["spectrum_label"] = scan.spectrum.label
    if scan.filter_map is not None:
        names = ("filter_material", "filter_thickness", "filter_density")
        content |= dict(zip(names, scan.filter_map))
    arrays = {name: np.asarray(value) for name, value in content.items() if value is not None}
    needed = sum(array.nbytes for array in arrays.values())
    with (
        replacing(path, overwrite=overwrite, needed_bytes=needed) as temporary,
        open(temporary, "wb") as file,
    ):
        np.savez(file, **arrays)  # type: ignore[arg-type]  # its stubs know only NumPy 2.1 and later

"""Data Exchange HDF5: ``/exchange/data`` (views, rows, columns), ``data_white``, ``data_dark``, ``theta``.

Arrays go through dxchange where it is installed, the rest through h5py. What the layout has no place for is kept
in a group of our own, ``/polysplat``:

- ``geometry``: attributes ``astra_type`` (``cone_vec``, ``parallel3d_vec`` or ``cyl_cone_vec``) and ``unit``;
  datasets ``vectors`` (views, 12 or 13), ``volume_shape`` (nz, ny, nx) and ``volume_window`` (xmin, xmax,
  ymin, ymax, zmin, zmax);
- ``spectrum``: datasets ``energies`` (keV) and ``weights``;
- ``truth`` (z, y, x) in 1/unit with attribute ``energy_kev``; ``metal_mask`` (z, y, x);
  ``valid`` (like data); ``water_correction``, the coefficients of ``Scan``; ``filter_thickness`` (rows, columns), with
  attributes ``material`` and ``density`` (g/cm3);
- ``scanner``: JSON text of what a scanner's folder told (``Scan.notes["scanner"]``).

The attribute ``input`` of ``/exchange/data`` tells counts, transmission and attenuation apart.
"""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_choice, require_number, require_shape
from tomo_polysplat.scan.centre import estimate_centre
from tomo_polysplat.scan.circular import parallel_geometry
from tomo_polysplat.scan.defects import flat_and_dark
from tomo_polysplat.scan.dxchange_host import read_block
from tomo_polysplat.scan.filter_map_file import read_filter_map
from tomo_polysplat.scan.hdf5 import (
    find_array,
    find_group,
    number_attribute,
    opened,
    read_json,
    read_numbers,
    read_spectrum,
    read_text,
    text_attribute,
)
from tomo_polysplat.scan.in_blocks import line_integrals
from tomo_polysplat.scan.layout import (
    spatial_geometry,
    vector_geometry,
    volume_geometry,
)
from tomo_polysplat.scan.reading import INPUT_KINDS, ReadOptions
from tomo_polysplat.scan.scan import Scan

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.scan.hdf5_array import StoredArray

__all__ = ["scan_from_hdf5"]

logger = logging.getLogger(__name__)

# Of the longest kind of vectors, and of a polynomial.
_PER_VECTOR, _MOST_COEFFICIENTS = 13, 100
# Open-beam or dark images beside fewer views than that.
_MOST_FRAMES = 1000
# Where APS tomography files keep the size of a pixel in the plane of the object. The size of a camera's own
# pixel is not used: without the magnification it is off by the objective's factor.
PIXEL_SIZE_PATHS = ("measurement/instrument/detection_system/objective/resolution",)
LENGTH_NAMES = {name: name for name in ("um", "mm", "cm", "m")}
LENGTH_NAMES |= dict.fromkeys(("micron", "microns", "micrometers"), "um")


def scan_from_hdf5(path: Path, options: ReadOptions) -> Scan:
    """Read a scan; see :func:`tomo_polysplat.load_scan`."""
    with opened(path) as file:
        if find_array(file, "polysplat/basis") is not None:
            raise fail("path", "a scan", f"the result of a reconstruction in {path}", "Result.load reads it")
        exchange = find_group(file, "exchange")
        data = None if exchange is None else find_array(exchange, "data")
        if exchange is None or data is None or data.ndim != 3 or 0 in data.shape:
            got = "no such dataset" if data is None else f"shape {data.shape}"
            raise fail("path", "a dataset /exchange/data of shape (views, rows, columns)", f"{got} in {path}")
        projections, valid, notes = _line_integrals(exchange, data, options)
        if find_array(file, "polysplat/valid") is not None:
            stored = read_numbers(file, "polysplat/valid", data.shape).astype(bool)
            valid &= stored.transpose(1, 0, 2)
        _report_defects(notes["rays"], valid)
        geometry = _geometry(file, projections, valid, options, notes)
        if (scanner := read_json(file, "polysplat/scanner", None)) is not None:
            notes["scanner"] = scanner
        return Scan(
            projections=projections,
            valid=None if valid.all() else valid,
            name=read_text(file, "measurement/sample/name") or path.stem,
            notes=notes,
            **geometry,
            **_knowledge(file, geometry["vol_geom"], options),
            filter_map=read_filter_map(file, projections.shape),
        )


def _line_integrals(
    exchange: h5py.Group, data: StoredArray, options: ReadOptions
) -> tuple[np.ndarray, np.ndarray, dict[str, Any]]:
    """Projections and validity in the order (rows, views, columns), read a block of views at a time."""
    rows, columns = data.shape[1:]
    white, dark = find_array(exchange, "data_white"), find_array(exchange, "data_dark")
    kind = _input_kind(data, white is not None, options.input)
    if kind != "counts" and options.saturation is not None:
        raise fail("saturation", "counts in the file", f"{kind}, which has none", "leave it out")
    flat = background = None
    if kind == "counts":
        if white is None:
            raise fail(
                "path",
                "/exchange/data_white beside counts",
                "none",
                "or pass input='transmission' or 'attenuation'",
            )
        for frames in (one for one in (white, dark) if one is not None):
            _require_few(frames, data)
        no_light, open_beam = None if dark is None else read_block(dark), read_block(white)
        flat, background = flat_and_dark(open_beam, no_light, (rows, columns))
        means = {"white_frames": _frame_means(open_beam), "dark_frames": _frame_means(no_light)}
    else:
        means = {}
    projections, valid, rays = line_integrals(
        lambda part: read_block(data, part),
        data.shape,
        kind,
        flat,
        background,
        options.saturation,
        options.progress,
    )
    return projections, valid, {"input": kind, "rays": rays} | means


def _frame_means(frames: np.ndarray | None) -> list[float]:
    """Mean counts of each open-beam or dark image, by which `check` questions them."""
    if frames is None:
        return []
    frames = frames[None] if frames.ndim == 2 else frames
    return [float(np.nanmean(frame, dtype=np.float64)) for frame in frames]


def _require_few(frames: StoredArray, data: StoredArray) -> None:
    """Refuse open-beam or dark images of another size than the data, or unreasonably many, before they are read."""
    if frames.ndim not in (2, 3) or frames.shape[-2:] != data.shape[1:]:
        raise fail(frames.name, f"frames of shape {data.shape[1:]}, as the data", f"{frames.shape}")
    most = max(_MOST_FRAMES, data.shape[0])
    if frames.ndim == 3 and len(frames) > most:
        raise fail(frames.name, f"at most {most} frames", f"{len(frames)}")


def _input_kind(data: StoredArray, has_white: bool, stated: str | None) -> str:
    """What the numbers are: as the caller or the file states it, else as they look, with a warning."""
    if stated is not None:
        return stated
    attribute = text_attribute(data, "input")
    if attribute is not None:
        return require_choice("attribute 'input' of /exchange/data", attribute, INPUT_KINDS)
    if has_white:
        return "counts"
    sample = np.asarray(data[:: max(1, data.shape[0] // 8)], np.float64)
    sample = sample[np.isfinite(sample)]
    if sample.size and np.percentile(sample, 99) > 30:
        raise fail(
            "input",
            "open-beam images (/exchange/data_white) for what looks like counts",
            "none",
            "or state input=",
        )
    # Air is the commonest value at one end: near 1 in transmission, near 0 in attenuation.
    kind = "transmission" if sample.size and 0.7 < np.percentile(sample, 95) < 1.3 else "attenuation"
    logger.warning("no open-beam images: the data look like %s; pass input= to be sure", kind)
    return kind


def _report_defects(rays: dict[str, int], valid: np.ndarray) -> None:
    lost = valid.size - np.count_nonzero(valid)
    if lost:
        kinds = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in rays.items() if count)
        logger.warning("%d of %d rays are left out (%s)", lost, valid.size, kinds or "marked in the file")


def _geometry(
    file: h5py.File, projections: np.ndarray, valid: np.ndarray, options: ReadOptions, notes: dict[str, Any]
) -> dict[str, Any]:
    """``proj_geom``, ``vol_geom`` and ``unit``: the caller's, the file's, or a parallel beam."""
    group = find_group(file, "polysplat/geometry")
    if options.proj_geom is not None or group is not None:
        options.refuse_parallel_only()
    if options.proj_geom is not None:
        assert options.vol_geom is not None  # ReadOptions refuses one without the other
        proj_geom = spatial_geometry(dict(options.proj_geom))
        return {
            "proj_geom": proj_geom,
            "vol_geom": dict(options.vol_geom),
            "unit": options.settled_unit(None, "cm"),
        }
    if group is not None:
        proj_geom = vector_geometry(
            _attribute(group, "astra_type"),
            read_numbers(group, "vectors", most=_PER_VECTOR * projections.shape[1]),
            projections.shape,
        )
        vol_geom = volume_geometry(
            read_numbers(group, "volume_shape", (3,)), read_numbers(group, "volume_window", (6,))
        )
        unit = options.settled_unit(_attribute(group, "unit"), "cm")
        return {"proj_geom": proj_geom, "vol_geom": dict(options.vol_geom or vol_geom), "unit": unit}
    rows, views, columns = projections.shape
    centre = options.centre
    theta = _angles(file, views, options.theta, centre)
    if centre is None:
        centre = estimate_centre(projections, theta, valid)
    notes |= {"centre": float(centre), "centre_estimated": options.centre is None}
    pixel_size, unit = _pixel_size(file, options)
    remedy = "in columns from the edge"
    centre = require_number("centre", centre, above=0, at_most=columns, remedy=remedy)
    # In degrees: those may be of many turns, where radians are looked at with suspicion.
    proj_geom, vol_geom = parallel_geometry(
        pixel=require_number("pixel_size", pixel_size, above=0),
        degrees=np.rad2deg(theta),
        detector=(rows, columns),
        offset=((columns / 2 - centre) * pixel_size, 0.0),
    )
    return {"proj_geom": proj_geom, "vol_geom": dict(options.vol_geom or vol_geom), "unit": unit}


def _attribute(group: h5py.Group, name: str) -> str:
    value = text_attribute(group, name)
    if value is None:
        raise fail("path", f"a text as attribute '{name}' of {group.name}", "none")
    return value


def _angles(file: h5py.File, views: int, given: Any, centre: float | None) -> np.ndarray:
    """View angles in radians."""
    in_radians = False
    if given is None:
        dataset = find_array(file, "exchange/theta")
        if dataset is None:
            raise _missing_theta(views)
        in_radians = (text_attribute(dataset, "units") or "").lower().startswith("rad")
        if dataset.shape != (views,):
            raise fail("theta", f"shape {(views,)} (views,)", f"{dataset.shape}")
        given = read_block(dataset)
    theta = require_array("theta", given, 1).astype(np.float64)
    require_shape("theta", theta, (views,), "(views,)")
    if not np.isfinite(theta).all():
        raise fail("theta", "finite angles", "NaN or infinity")
    if not in_radians and views > 2 and np.ptp(theta) < 2 * np.pi + 0.1:
        logger.warning("theta spans %.3g degrees only: are these radians?", np.ptp(theta))
        # Without half a turn the axis cannot be found either, and to give it would hide what is wrong.
        if centre is None:
            got = f"{np.ptp(theta):.3g} degrees from the first to the last, which look like radians"
            remedy = (
                "set the attribute units = 'rad' of /exchange/theta, or pass theta= in degrees; else centre="
            )
            raise fail("theta", "at least half a turn", got, remedy)
    return theta if in_radians else np.deg2rad(theta)


def _missing_theta(views: int) -> Exception:
    return fail(
        "theta",
        "the angle of every view",
        "no /exchange/theta in the file",
        f"pass theta= in degrees, such as numpy.linspace(0, 180, {views}, endpoint=False)",
    )


def _pixel_size(file: h5py.File, options: ReadOptions) -> tuple[float, str]:
    """Size of a pixel in the plane of the object, and its unit; ``(1, "pixel")`` when unknown."""
    if options.pixel_size is not None:
        return options.pixel_size, options.settled_unit(None, "cm")
    for path in PIXEL_SIZE_PATHS:
        dataset = find_array(file, path)
        if dataset is not None and dataset.size == 1:
            unit = LENGTH_NAMES.get((text_attribute(dataset, "units") or "").lower())
            if unit is not None:
                return float(np.asarray(dataset[()]).reshape(())), options.settled_unit(unit, unit)
    if options.unit not in (None, "pixel"):
        raise fail(
            "unit", "'pixel', as the file states no pixel size", repr(options.unit), "pass pixel_size= too"
        )
    return 1.0, "pixel"


def _knowledge(file: h5py.File, vol_geom: dict[str, Any], options: ReadOptions) -> dict[str, Any]:
    """Spectrum, water correction, truth and metal mask, where the file has them."""
    known: dict[str, Any] = {"spectrum": options.spectrum, "water_correction": options.water_correction}
    group = find_group(file, "polysplat")
    if group is None:
        return known
    known["spectrum"] = options.spectrum or read_spectrum(group)
    if options.water_correction is None and find_array(group, "water_correction") is not None:
        known["water_correction"] = read_numbers(group, "water_correction", most=_MOST_COEFFICIENTS)
    truth = find_array(group, "truth")
    if options.vol_geom is None and truth is not None:
        shape = tuple(int(vol_geom[f"Grid{axis}Count"]) for axis in ("Slice", "Row", "Col"))
        known["truth"] = read_numbers(group, "truth", shape)
        known["truth_energy_kev"] = number_attribute(truth, "energy_kev")
        if find_array(group, "metal_mask") is not None:
            known["metal_mask"] = read_numbers(group, "metal_mask", shape)
    return known

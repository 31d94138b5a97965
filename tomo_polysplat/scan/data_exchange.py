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
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, visible
from tomo_polysplat.free_memory import in_gigabytes
from tomo_polysplat.scan.counts import Counts, Marks, Read
from tomo_polysplat.scan.data_exchange_parallel import parallel_told
from tomo_polysplat.scan.data_exchange_pictures import input_kind, pictures_of, references_of
from tomo_polysplat.scan.defects import flat_and_dark
from tomo_polysplat.scan.dxchange_host import read_block
from tomo_polysplat.scan.filter_map_file import read_filter_map
from tomo_polysplat.scan.half_acquisition import with_room
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
from tomo_polysplat.scan.in_blocks import line_integrals, looked_through
from tomo_polysplat.scan.layout import (
    spatial_geometry,
    vector_geometry,
    volume_geometry,
)
from tomo_polysplat.scan.readers.part import Part
from tomo_polysplat.scan.readers.scan_part import scan_part
from tomo_polysplat.scan.reading import ReadOptions
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.scan.stored_part import StoredPart
from tomo_polysplat.scan.stored_views import StoredViews

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.scan.hdf5_array import StoredArray

__all__ = ["scan_from_hdf5"]

logger = logging.getLogger(__name__)

# Of the longest kind of vectors, and of a polynomial.
_PER_VECTOR, _MOST_COEFFICIENTS = 13, 100
# Open-beam or dark images beside fewer views than that.
_MOST_FRAMES = 1000
# Bytes of the projections as float32 from which they stay in the file.
_STAYS = 1 << 30
# How often a chunk is unpacked without a word.
_MOST_TIMES = 3
_ALL = Part()


def scan_from_hdf5(path: Path, options: ReadOptions, part: Part = _ALL) -> Scan:
    """Read a scan; see :func:`tomo_polysplat.load_scan`. What a `part` leaves out is not read, as far as that goes."""
    with opened(path) as file:
        if find_array(file, "polysplat/basis") is not None:
            raise fail("path", "a scan", f"the result of a reconstruction in {path}", "Result.load reads it")
        data = pictures_of(file, path)
        exchange = find_group(file, "exchange")
        assert exchange is not None  # the pictures are in it
        now, later = _in_two(part, file, options)
        wanted = StoredPart(data, now)
        stay = 4 * prod(wanted.shape) >= _STAYS and find_array(file, "polysplat/valid") is None
        views_of = StoredViews(path, now) if stay else lambda: nullcontext(wanted.block)
        counts, notes = _counts(views_of, exchange, data, wanted, options)
        _tell_of_chunks(data, counts.at_once, path)
        made = _left_there(counts, options, notes) if stay else _read(counts, file, wanted, options, notes)
        projections, valid, left_out = made
        _report_defects(notes["rays"], left_out, counts.size)
        views, rows, columns = data.shape
        whole = _geometry(file, (rows, views, columns), (projections, valid, wanted), options, notes)
        geometry, same = wanted.geometries(whole, options.vol_geom)
        known = _knowledge(file, whole["vol_geom"], options)
        if not same:
            known |= {"truth": None, "metal_mask": None}
        if (scanner := read_json(file, "polysplat/scanner", None)) is not None:
            notes["scanner"] = scanner
        scan = Scan(
            projections=projections,
            valid=valid if left_out else None,
            name=read_text(file, "measurement/sample/name") or path.stem,
            notes=notes,
            **geometry,
            **known,
            filter_map=wanted.filters(read_filter_map(file, (rows, views, columns))),
        )
        usual = options.proj_geom is None and options.vol_geom is None
        own = find_group(file, "polysplat/geometry") is not None
    scan = scan if later.whole else scan_part(scan, later, options.vol_geom)
    return with_room(scan) if usual and not own else scan


def _in_two(part: Part, file: h5py.File, options: ReadOptions) -> tuple[Part, Part]:
    """What to leave out while reading, and afterwards: an axis is looked for in whole rows, light is averaged last."""
    group = find_group(file, "polysplat/geometry")
    if options.proj_geom is None and group is not None and _attribute(group, "astra_type") == "cyl_cone_vec":
        return _ALL, part
    known = options.proj_geom is not None or group is not None or options.centre is not None
    now = Part(part.rows, part.columns if known else None, part.views)
    return now, Part(columns=None if known else part.columns, binning=part.binning)


def _tell_of_chunks(data: StoredArray, at_once: int, path: Path) -> None:
    """Say what mends chunks that are unpacked again and again, as they hold many views and little of each."""
    if not data.filters:
        return
    # Of so many views, of which some are read at a time.
    times = 1 + (data.dataset.chunks[0] - 1) / min(at_once, data.shape[0])
    if times > _MOST_TIMES:
        one = "x".join(map(str, (1, *data.shape[1:])))
        logger.warning(
            "The chunks of %s are unpacked %.0f times over, as each has %d views: h5repack -l %s:CHUNK=%s %s new.h5 "
            "makes a file that is read faster.",
            *(data.name, times, data.dataset.chunks[0], data.name, one, visible(path)),
        )


def _left_there(counts: Counts, options: ReadOptions, notes: dict[str, Any]) -> tuple[Counts, Marks, int]:
    """Projections and validity that stay in the file, and how many rays are not valid, of which `notes` gets counts."""
    notes["rays"] = looked_through(counts, options.progress)
    logger.info("The projections stay in the file: %s as float32.", in_gigabytes(counts.nbytes))
    return counts, counts.marks, sum(notes["rays"].values())


def _read(
    counts: Counts, file: h5py.File, wanted: StoredPart, options: ReadOptions, notes: dict[str, Any]
) -> tuple[np.ndarray, np.ndarray, int]:
    """The same read as a whole."""
    projections, valid, notes["rays"] = line_integrals(counts, options.progress)
    if find_array(file, "polysplat/valid") is not None:
        stored = wanted.of_views(read_numbers(file, "polysplat/valid", wanted.whole_shape).astype(bool))
        valid &= wanted.of_pixels(stored).transpose(1, 0, 2)
    return projections, valid, valid.size - int(np.count_nonzero(valid))


def _counts(
    views: Callable[[], AbstractContextManager[Read]],
    exchange: h5py.Group,
    data: StoredArray,
    wanted: StoredPart,
    options: ReadOptions,
) -> tuple[Counts, dict[str, Any]]:
    """What is stored, with what is needed to make line integrals of it, and notes of what that is."""
    rows, columns = data.shape[1:]
    white, dark = (references_of(exchange.file, name) for name in ("data_white", "data_dark"))
    kind = input_kind(data, bool(white), options.input)
    if kind != "counts" and options.saturation is not None:
        raise fail("saturation", "counts in the file", f"{kind}, which has none", "leave it out")
    flat = background = None
    if kind == "counts":
        if not white:
            raise fail(
                "path",
                "/exchange/data_white beside counts",
                "none",
                "or pass input='transmission' or 'attenuation'",
            )
        for frames in (*white, *dark):
            _require_few(frames, data)
        no_light, open_beam = _together(dark) if dark else None, _together(white)
        flat, background = map(wanted.of_pixels, flat_and_dark(open_beam, no_light, (rows, columns)))
        means = {"white_frames": _frame_means(open_beam), "dark_frames": _frame_means(no_light)}
    else:
        means = {}
    counts = Counts(views, wanted.shape, kind, flat, background, options.saturation)
    return counts, {"input": kind} | means


def _frame_means(frames: np.ndarray | None) -> list[float]:
    """Mean counts of each open-beam or dark image, by which `check` questions them."""
    if frames is None:
        return []
    return [float(np.nanmean(frame, dtype=np.float64)) for frame in frames]


def _together(stored: list[StoredArray]) -> np.ndarray:
    """All of these pictures (n, rows, columns); one alone may have no axis for their number."""
    read = [read_block(frames) for frames in stored]
    return np.concatenate([frames[None] if frames.ndim == 2 else frames for frames in read])


def _require_few(frames: StoredArray, data: StoredArray) -> None:
    """Refuse open-beam or dark images of another size than the data, or unreasonably many, before they are read."""
    if frames.ndim not in (2, 3) or frames.shape[-2:] != data.shape[1:]:
        raise fail(frames.name, f"frames of shape {data.shape[1:]}, as the data", f"{frames.shape}")
    most = max(_MOST_FRAMES, data.shape[0])
    if frames.ndim == 3 and len(frames) > most:
        raise fail(frames.name, f"at most {most} frames", f"{len(frames)}")


def _report_defects(rays: dict[str, int], lost: int, size: int) -> None:
    if lost:
        kinds = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in rays.items() if count)
        logger.warning("%d of %d rays are left out (%s)", lost, size, kinds or "marked in the file")


def _geometry(
    file: h5py.File,
    shape: tuple[int, int, int],
    seen: tuple[np.ndarray | Counts, np.ndarray | Marks, StoredPart],
    options: ReadOptions,
    notes: dict[str, Any],
) -> dict[str, Any]:
    """``proj_geom``, ``vol_geom`` and ``unit`` of all: the caller's, the file's, or a parallel beam.

    `seen` are projections with their validity, in which the axis is looked for, and what part of all they are.
    """
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
            read_numbers(group, "vectors", most=_PER_VECTOR * shape[1]),
            shape,
        )
        vol_geom = volume_geometry(
            read_numbers(group, "volume_shape", (3,)), read_numbers(group, "volume_window", (6,))
        )
        unit = options.settled_unit(_attribute(group, "unit"), "cm")
        return {"proj_geom": proj_geom, "vol_geom": dict(options.vol_geom or vol_geom), "unit": unit}
    return parallel_told(file, shape, seen, options, notes)


def _attribute(group: h5py.Group, name: str) -> str:
    value = text_attribute(group, name)
    if value is None:
        raise fail("path", f"a text as attribute '{name}' of {group.name}", "none")
    return value


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

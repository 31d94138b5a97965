"""The parallel beam of a Data Exchange file that states no geometry: angles, axis and pixel."""

from __future__ import annotations

import logging
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_number, require_shape
from tomo_polysplat.scan.centre import chosen_rows, estimate_centre
from tomo_polysplat.scan.circular import parallel_geometry
from tomo_polysplat.scan.counts import Counts, Marks
from tomo_polysplat.scan.dxchange_host import read_block
from tomo_polysplat.scan.hdf5 import find_array, is_in_radians, text_attribute
from tomo_polysplat.scan.reading import ReadOptions

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.scan.stored_part import StoredPart

__all__ = ["parallel_told"]

logger = logging.getLogger(__name__)

# Where APS tomography files keep the size of a pixel in the plane of the object. The size of a camera's own
# pixel is not used: without the magnification it is off by the objective's factor.
PIXEL_SIZE_PATHS = ("measurement/instrument/detection_system/objective/resolution",)
LENGTH_NAMES = {name: name for name in ("um", "mm", "cm", "m")}
LENGTH_NAMES |= dict.fromkeys(
    ("micron", "microns", "micrometer", "micrometers", "micrometre", "micrometres"), "um"
)


def parallel_told(
    file: h5py.File,
    shape: tuple[int, int, int],
    seen: tuple[np.ndarray | Counts, np.ndarray | Marks, StoredPart],
    options: ReadOptions,
    notes: dict[str, Any],
) -> dict[str, Any]:
    """``proj_geom``, ``vol_geom`` and ``unit`` of all, (rows, views, columns); what was found goes into `notes`.

    `seen` are projections with their validity, in which the axis is looked for, and what part of all they are.
    """
    rows, views, columns = shape
    centre = options.centre
    theta = _angles(file, views, options.theta, centre)
    if centre is None:
        projections, valid, wanted = seen
        if isinstance(projections, Counts):
            # The rows that tell, read once.
            rows_told = chosen_rows(projections.shape[0])
            projections, valid = projections[rows_told], valid[rows_told]
        centre = estimate_centre(projections, wanted.of_views(theta), np.asarray(valid))
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


def _angles(file: h5py.File, views: int, given: Any, centre: float | None) -> np.ndarray:
    """View angles in radians."""
    in_radians = False
    if given is None:
        dataset = find_array(file, "exchange/theta")
        if dataset is None:
            raise _missing_theta(views)
        in_radians = is_in_radians(dataset)
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
        f"pass theta= in degrees, such as numpy.linspace(0, 180, {views}, endpoint=False), or "
        "`tomo-polysplat import SCAN --angles 180`",
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

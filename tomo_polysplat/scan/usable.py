"""Which of the rays that a caller hands over are measurements, and what they were before a water correction."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_shape
from tomo_polysplat.parallel import run_tasks, split_range
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.water_correction import undo_water_correction
from tomo_polysplat.scan.apart_columns import columns_not_measured
from tomo_polysplat.scan.counts import Counts, Marks
from tomo_polysplat.scan.erratic import erratic_pixels
from tomo_polysplat.scan.geometry import (
    Geometry,
    geometry_from_astra,
    is_planar_geometry,
    projections_from_astra,
    require_projections,
)
from tomo_polysplat.scan.light_end import mend_light_end
from tomo_polysplat.scan.line_integrals import require_line_integrals
from tomo_polysplat.scan.noise import photons_per_ray
from tomo_polysplat.scan.opaque import fill_opaque, opaque_value
from tomo_polysplat.scan.scale_end import fill_dark_end
from tomo_polysplat.scan.stuck import stuck_pixels

__all__ = ["UsableRays", "usable_rays"]

logger = logging.getLogger(__name__)

# No number above 0 has a logarithm beyond this in float64.
_LARGEST_LOGARITHM = 745.0
# Warn if more than this share of the rays is left out: the mask may be inverted.
_MOST_LEFT_OUT = 0.2
# Rays looked at by one thread.
_AT_ONCE = 1 << 20


class UsableRays(NamedTuple):
    """What a reconstruction takes of a scan.

    Attributes
    ----------
    values : (views, rows, columns) float32 array
        -log(I/I0); NaN where a ray is not to be used.
    counts : dict
        How many rays there are of which kind.
    given : tuple of float
        Values that opaque and saturated rays were given.
    """

    values: np.ndarray
    counts: dict[str, int]
    given: tuple[float, ...]


# One step after another, each of which takes rays out and counts them.
def usable_rays(
    projections: Any,
    proj_geom: Mapping[str, Any],
    valid: Any,
    water_correction: Sequence[float] | None = None,
    spectrum: Spectrum | None = None,
) -> UsableRays:
    """Projections (views, rows, columns) with NaN for every ray that is not to be used, and their counts.

    A water correction is undone, and opaque rays have a value (`scan.opaque`). Parameters and errors are those of
    :func:`tomo_polysplat.reconstruct`.
    """
    if isinstance(projections, Counts) and proj_geom.get("type") != "cyl_cone_vec":
        values, marked = _of_counts(projections, valid, proj_geom)
    else:
        values, marked = _of_array(projections, valid, proj_geom)
    require_line_integrals(values, marked)
    # So many that little is there besides while it is looked at.
    many = max(64, values.size // _AT_ONCE)
    parts = [
        (values[a:b], None if marked is None else marked[a:b]) for a, b in split_range(len(values), many)
    ]
    found = run_tasks(_take_out, parts)
    counts = {"rays": values.size} | {name: sum(part[name] for part in found) for name in found[0]}
    geometry = geometry_from_astra(proj_geom)
    stuck = stuck_pixels(values, _axis_column(geometry))
    counts["rays_of_stuck_pixels"] = _left_out(values, stuck)
    if stuck.any():
        logger.warning("Pixels that show the same value in every view are left out: %d.", stuck.sum())
    if counts["rays_not_finite"]:
        erratic = erratic_pixels(values)
        counts["rays_of_stuck_pixels"] += _left_out(values, erratic)
        if erratic.any():
            words = "without light in some views and brighter than the open beam in others"
            logger.warning("Pixels that are %s are left out: %d.", words, erratic.sum())
    apart = columns_not_measured(values, geometry)
    counts["rays_of_columns_apart"] = _left_out(values, np.broadcast_to(apart, stuck.shape))
    if apart.any():
        words = ", ".join(map(str, np.flatnonzero(apart)))
        logger.warning("Columns of noise, or unlike both neighbours in all views, are left out: %s.", words)
    used = counts.pop("used") - counts["rays_of_stuck_pixels"] - counts["rays_of_columns_apart"]
    if used == 0:
        remedy = "give -log(I/I0), not intensities, and check the flat fields and the mask"
        raise fail("projections", "at least one usable ray", "none", remedy)
    values = _uncorrected(values, water_correction, spectrum)
    if proj_geom.get("type") == "cyl_cone_vec":
        # After resampling, a ray that uses any ray without light, or a saturated one, is infinite.
        values[np.isinf(values)] = np.nan
    if counts["rays_not_finite"] and any(np.isposinf(view).any() for view in values):
        photons = photons_per_ray(values)
        counts["rays_opaque"] = fill_opaque(values, photons)
        given = [opaque_value(photons)] if counts["rays_opaque"] else []
        counts["rays_not_finite"] -= counts["rays_opaque"]
        used += counts["rays_opaque"]
    else:
        # A scale that goes to infinity has no end before.
        counts["rays_opaque"], given = fill_dark_end(values)
    saturated, told = mend_light_end(values)
    if saturated:
        given.append(0.0)
        counts["rays_saturated"] = saturated
        counts["rays_not_finite"] -= told
        used += told
    if used < (1 - _MOST_LEFT_OUT) * values.size:
        _tell_left_out({name: n for name, n in counts.items() if name != "rays_opaque"}, used)
    if counts["rays_opaque"]:
        logger.info(
            "Rays that no light came through, opaque by what is around them: %d.", counts["rays_opaque"]
        )
    return UsableRays(values, counts, tuple(given))


def _left_out(values: np.ndarray, pixels: np.ndarray) -> int:
    """Make the rays of these pixels NaN, and count them."""
    if not pixels.any():
        return 0
    count = int(np.isfinite(values[:, pixels]).sum())
    values[:, pixels] = np.nan
    return count


def _axis_column(geometry: Geometry) -> float | None:
    """The column on which the world's axis falls in all views, to a column; None where it does in none or another."""
    columns = geometry.project_points(np.zeros((1, 3)))[:, 0, 0]
    return float(np.median(columns)) if np.ptp(columns) < 1.0 else None


def _of_array(
    projections: Any, valid: Any, proj_geom: Mapping[str, Any]
) -> tuple[np.ndarray, np.ndarray | None]:
    """Projections (views, rows, columns) that may be changed, and rays that are not to be used."""
    projections, valid = _on_host(projections), _on_host(valid)
    if isinstance(projections, np.ma.MaskedArray):
        valid = ~np.ma.getmaskarray(projections) & (
            True if valid is None else require_array("valid", valid) > 0
        )
    # Values beyond float32 become infinite, and are counted as infinite.
    with np.errstate(over="ignore"):
        values = projections_from_astra(projections, proj_geom)
    if np.may_share_memory(values, np.asarray(projections)):
        values = values.copy()
    marked = None if valid is None else _marked(valid, np.shape(projections), proj_geom)
    return values, marked


def _of_counts(
    counts: Counts, valid: Any, proj_geom: Mapping[str, Any]
) -> tuple[np.ndarray, np.ndarray | None]:
    """The same of counts, some views at a time: nothing else is ever there as a whole.

    A ray that was not measured properly is not used, whatever a mask says.
    """
    require_projections(counts, proj_geom)
    rows, views, columns = counts.shape
    values = np.empty((views, rows, columns), np.float32)
    own = valid is None or _is_own(valid, counts)
    marked = None if own else _marked(_on_host(valid), counts.shape, proj_geom)
    for block in counts.blocks(values):
        if any(block.found.values()):
            marked = np.zeros(values.shape, bool) if marked is None else marked
            marked[block.views] |= block.marked
    return values, marked


def _is_own(valid: Any, counts: Counts) -> bool:
    """Whether a mask is what the counts themselves tell."""
    return isinstance(valid, Marks) and valid.counts is counts and valid.lightless


def _marked(valid: Any, shape: tuple[int, ...], proj_geom: Mapping[str, Any]) -> np.ndarray:
    """(views, rows, columns) True for rays that are not to be used, of a mask in the order of the projections."""
    mask = require_array("valid", valid)
    require_shape("valid", mask, shape, "of the projections")
    usable = mask > 0.5
    if proj_geom.get("type") == "cyl_cone_vec":
        # A curved detector is resampled: a ray that uses any invalid pixel is invalid, too.
        return ~(projections_from_astra(usable.astype(np.float32), proj_geom) >= 1)
    ordered = usable[:, None] if is_planar_geometry(proj_geom) else usable.swapaxes(0, 1)
    return np.logical_not(ordered, out=np.empty(ordered.shape, bool))


def _on_host(values: Any) -> Any:
    """A tensor on the host and without gradients, as NumPy needs it; anything else as it is."""
    return values.detach().cpu() if hasattr(values, "detach") else values


def _tell_left_out(counts: Mapping[str, int], used: int) -> None:
    reasons = {
        name.removeprefix("rays_").replace("_", " "): n for name, n in counts.items() if name != "rays"
    }
    listed = ", ".join(f"{n} {reason}" for reason, n in reasons.items() if n)
    remedy = (
        "; False in valid= is for rays that must not be used" if counts.get("rays_marked_invalid") else ""
    )
    logger.warning("Only %d of %d rays are used: %s%s.", used, counts["rays"], listed, remedy)


def _take_out(values: np.ndarray, marked: np.ndarray | None) -> dict[str, int]:
    """Make every ray that is not to be used NaN; return how many there were of each kind, and how many are used."""
    names = ["rays_not_finite", *(["rays_marked_invalid"] if marked is not None else []), "rays_out_of_range"]
    extreme = max(float(values.max()), -float(values.min())) if values.size else 0.0
    if extreme <= _LARGEST_LOGARITHM and (marked is None or not marked.any()):
        # As in most scans; with NaN or infinity the comparison would be False.
        return dict.fromkeys(names, 0) | {"used": values.size}
    bad = ~np.isfinite(values)
    counts = {"rays_not_finite": int(np.count_nonzero(bad))}
    if marked is not None:
        # Of saturated rays it says why they are no number.
        counts["rays_not_finite"] -= int(np.count_nonzero(marked & np.isneginf(values)))
        counts["rays_marked_invalid"] = int(np.count_nonzero(marked))
        bad |= marked
    beyond = np.isinf(values)
    if marked is not None:
        beyond &= ~marked
    # Rays without light, or saturated, stay infinite for now: `fill_opaque` and `mend_light_end` judge them.
    values[bad & ~beyond] = np.nan
    impossible = (np.abs(values) > _LARGEST_LOGARITHM) & ~beyond
    counts["rays_out_of_range"] = int(np.count_nonzero(impossible))
    values[impossible] = np.nan
    bad |= impossible
    return counts | {"used": bad.size - int(np.count_nonzero(bad))}


def _uncorrected(
    values: np.ndarray, water_correction: Sequence[float] | None, spectrum: Spectrum | None
) -> np.ndarray:
    """The projections before the scanner's water correction."""
    if water_correction is None:
        return values
    if spectrum is None:
        remedy = "a monochromatic model wants the values as they are: leave water_correction out"
        raise fail("water_correction", "a spectrum beside it", "none", remedy)
    return undo_water_correction(values, water_correction, np.float32)

"""Do rays that were measured from both ends agree: where is the axis, and which way round did the scan go?

The ray from a source at azimuth b that leaves at the angle g from the axis is met again, backwards, from the
azimuth b + pi + 2 g at the angle -g. If the detector is off by some columns, or the angles run the other way
(b + pi - 2 g), the two do not agree. In a parallel beam g is zero, and turning the angles round gives the mirror
image of the object, which agrees as well as the object itself.
"""

from __future__ import annotations

from dataclasses import replace

from tomo_polysplat.scan.assumptions import RULED_OUT
from tomo_polysplat.scan.axis_offset import LARGEST_SHARE, AxisOffset, axis_offset, offset_of
from tomo_polysplat.scan.centre import find_centre
from tomo_polysplat.scan.opposite_geometry import opposite_rays_of
from tomo_polysplat.scan.probes.direction import MUCH_BETTER, REMEDY, direction_doubt, turned_round
from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured

__all__ = ["CENTRE", "DIRECTION", "probe_centre_and_direction"]

# Columns off from which it is a defect, and the largest standard error at which that would have shown.
_TOLERATED, _TELLING = 0.5, 0.5

CENTRE, DIRECTION = "centre", "direction of the angles"
_NEEDS = "a calibration of the scanner, or an object with detail where rays were measured from both ends"
_FITS = "recon looks for it by short fits"


def probe_centre_and_direction(measured: Measured) -> list[Finding]:
    """Compare rays with those that ran the same way backwards."""
    views = measured.scan.projections.swapaxes(0, 1), measured.geometry, measured.valid.swapaxes(0, 1)
    if measured.geometry.beam == "parallel":
        text = "a parallel beam cannot tell: turned angles give the mirror image of the object"
        found = axis_offset(*views)
        found = _or_far_off(measured, found) if found.doubt else found
        return [_centre(found), Finding(DIRECTION, UNKNOWN, text, "an object that is known")]
    try:
        rays = opposite_rays_of(*views)
    except ValueError as error:
        return [Finding(name, UNKNOWN, str(error), _NEEDS) for name in (CENTRE, DIRECTION)]
    told, turned = offset_of(rays), offset_of(turned_round(rays))
    doubt, ratio = direction_doubt(rays, told, turned)
    numbers = {"ratio": ratio, "standard errors": abs(doubt)}
    if doubt < -RULED_OUT and ratio > MUCH_BETTER and not turned.doubt:
        text = f"opposite rays agree {ratio:.1f} times better with the angles turned round"
        turn = Finding(DIRECTION, DEFECT, text, REMEDY, numbers)
        return [_centre(turned), turn]
    return [_centre(told), _direction(told, doubt, numbers)]


def _direction(told: AxisOffset, doubt: float, numbers: dict[str, float]) -> Finding:
    better = f"{1 / numbers['ratio']:.1f} times better than turned"
    if doubt > RULED_OUT and not told.doubt:
        return Finding(DIRECTION, OK, f"opposite rays agree {better}", "", numbers)
    text = "opposite rays agree about as well with the angles turned round"
    return Finding(DIRECTION, UNKNOWN, text, _NEEDS, numbers)


def _or_far_off(measured: Measured, unknown: AxisOffset) -> AxisOffset:
    """An axis of a parallel beam that is farther off than `axis_offset` looks: told by it from near there."""
    views, valid = measured.scan.projections.swapaxes(0, 1), measured.valid.swapaxes(0, 1)
    geometry = measured.geometry
    try:
        stated = opposite_rays_of(views, geometry, valid).axis + 0.5
        rough = find_centre(measured.filled, measured.azimuth, measured.good)
    except ValueError:
        return unknown
    far = rough.place - stated
    if rough.doubt or abs(far) <= LARGEST_SHARE * geometry.columns:
        return unknown
    near = axis_offset(views, replace(geometry, corner=geometry.corner - far * geometry.u), valid)
    return near if near.doubt else AxisOffset(near.columns - far, near.error)


def _centre(found: AxisOffset) -> Finding:
    """The finding on an axis in the data."""
    if found.doubt:
        return Finding(CENTRE, UNKNOWN, found.doubt, _NEEDS)
    # The axis is above where it was told if the detector stood below.
    offset, error = -found.columns, found.error
    numbers = {"offset": offset}
    size = f"{abs(offset):.2f} columns (standard error {error:.2g})"
    side = "above" if offset > 0 else "below"
    if abs(offset) > _TOLERATED + RULED_OUT * error:
        text = f"the rotation axis falls {size} {side} where the geometry has it"
        remedy = f"move the detector: astra.geom_postalignment(proj_geom, ({-offset:.2f}, 0.0))"
        return Finding(CENTRE, DEFECT, text, remedy, numbers, error)
    if error > _TELLING:
        text = f"the axis is known to {error:.2g} columns only"
        return Finding(CENTRE, UNKNOWN, text, _NEEDS, numbers, error)
    if abs(offset) > _TOLERATED:
        text = f"the rotation axis may fall {size} {side} where the geometry has it"
        return Finding(CENTRE, UNKNOWN, text, f"{_FITS}, or {_NEEDS}", numbers, error)
    return Finding(CENTRE, OK, f"within {size} of where the geometry has it", "", numbers, error)

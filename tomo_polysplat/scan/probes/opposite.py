"""Do rays that were measured from both ends agree: where is the axis, and which way round did the scan go?

The ray from a source at azimuth b that leaves at the angle g from the axis is met again, backwards, from the
azimuth b + pi + 2 g at the angle -g. If the detector is off by some columns, or the angles run the other way
(b + pi - 2 g), the two do not agree. In a parallel beam g is zero, and turning the angles round gives the mirror
image of the object, which agrees as well as the object itself.
"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.centre import find_centre
from tomo_polysplat.scan.evidence import RULED_OUT, Located
from tomo_polysplat.scan.probes.fan import Fan
from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured

__all__ = ["CENTRE", "DIRECTION", "probe_centre_and_direction"]

# Columns off from which it is a defect, and the largest standard error at which that would have shown.
_TOLERATED, _TELLING = 0.5, 0.5
# Of a defect, the other direction must fit this many times better.
_MUCH_BETTER = 2.0

CENTRE, DIRECTION = "centre", "direction of the angles"
_NEEDS = "a calibration of the scanner, or an object with detail where rays were measured from both ends"


def probe_centre_and_direction(measured: Measured) -> list[Finding]:
    """Compare rays with those that ran the same way backwards."""
    if measured.geometry.beam == "parallel":
        text = "a parallel beam cannot tell: turned angles give the mirror image of the object"
        return [_parallel_centre(measured), Finding(DIRECTION, UNKNOWN, text, "an object that is known")]
    try:
        fan = Fan(measured)
        told, turned = fan.locate(+1), fan.locate(-1)
    except ValueError as error:
        return [Finding(name, UNKNOWN, str(error), _NEEDS) for name in (CENTRE, DIRECTION)]
    doubt = fan.direction_doubt(told.place, turned.place)
    ratio = told.mismatch / turned.mismatch
    numbers = {"ratio": ratio, "standard errors": abs(doubt)}
    if doubt < -RULED_OUT and ratio > _MUCH_BETTER and not turned.doubt:
        text = f"opposite rays agree {ratio:.1f} times better with the angles turned round"
        found = Finding(DIRECTION, DEFECT, text, "take the angles times -1 (or reverse the views)", numbers)
        return [_centre(turned, 0.0), found]
    return [_centre(told, 0.0), _direction(told, doubt, numbers)]


def _direction(told: Located, doubt: float, numbers: dict[str, float]) -> Finding:
    better = f"{1 / numbers['ratio']:.1f} times better than turned"
    if doubt > RULED_OUT and not told.doubt:
        return Finding(DIRECTION, OK, f"opposite rays agree {better}", "", numbers)
    text = "opposite rays agree about as well with the angles turned round"
    return Finding(DIRECTION, UNKNOWN, text, _NEEDS, numbers)


def _parallel_centre(measured: Measured) -> Finding:
    geometry = measured.geometry
    lean = np.abs(geometry.origin[:, 2]) / np.linalg.norm(geometry.origin, axis=1)
    width, height = measured.grid.extent.max(), geometry.pixel_size_at(measured.grid.centre)[1]
    if lean.max() * width > height:
        return Finding(CENTRE, UNKNOWN, "the beam is inclined to the axis", _NEEDS)
    ends = measured.grid.extent[2] * np.array([[0, 0, -0.5], [0, 0, 0.5]]) * (geometry.rows > 1)
    axis = geometry.project_points(ends)
    if np.ptp(axis[..., 0]) > _TOLERATED or np.ptp(axis[..., 1], axis=0).max() > 1:
        return Finding(CENTRE, UNKNOWN, "the axis moves or leans on the detector", _NEEDS)
    stated = float(np.median(axis[..., 0])) + 0.5
    try:
        found = find_centre(measured.filled, measured.azimuth, measured.good)
    except ValueError as error:
        return Finding(CENTRE, UNKNOWN, str(error), _NEEDS)
    return _centre(found, stated)


def _centre(found: Located, stated: float) -> Finding:
    """The finding on an axis in the data, where the geometry has it at `stated`, in columns."""
    offset = found.place - stated
    numbers = {"offset": offset, "stated": stated, "found": found.place, "mismatch": found.mismatch}
    if found.doubt:
        return Finding(CENTRE, UNKNOWN, found.doubt, _NEEDS, numbers)
    error = found.uncertainty
    size = f"{abs(offset):.2f} columns (standard error {error:.2g})"
    if abs(offset) > _TOLERATED + RULED_OUT * error:
        side = "above" if offset > 0 else "below"
        text = f"the rotation axis falls {size} {side} where the geometry has it"
        remedy = f"move the detector: astra.geom_postalignment(proj_geom, ({-offset:.2f}, 0.0))"
        return Finding(CENTRE, DEFECT, text, remedy, numbers, error)
    if error > _TELLING:
        return Finding(
            CENTRE, UNKNOWN, f"the axis is known to {error:.2g} columns only", _NEEDS, numbers, error
        )
    return Finding(CENTRE, OK, f"within {size} of where the geometry has it", "", numbers, error)

"""Does the object reach beyond the detector?"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured

__all__ = ["TRUNCATION", "probe_truncation"]

TRUNCATION = "truncation"
# Share of the scan's large values that the outermost columns reach where there is more than air, and share of
# the views in which they must do so.
_NOT_AIR, _SOME_VIEWS = 0.06, 0.02
_SURE = 4.0
# Columns by which nobody places a detector beside the axis without wanting to.
_OFF_CENTRE = 1.0


def probe_truncation(measured: Measured) -> Finding:
    """Look for matter in the outermost columns."""
    values = measured.filled
    width = max(1, min(3, values.shape[2] // 20))
    ends = {"first": values[..., :width], "last": values[..., -width:]}
    zero = measured.air.level if measured.air is not None else 0.0
    # The rows with most matter decide, the same in all views: each view's own would be those with most noise.
    most = np.argsort(values.mean(axis=(1, 2)))[-max(1, len(values) // 4) :]
    shares, errors = {}, {}
    for name, end in ends.items():
        some = end[most] - zero
        noise = float(np.median(np.abs(np.diff(some, axis=1)))) * 1.4826 / np.sqrt(2)
        errors[name] = noise / np.sqrt(width * len(most))
        limit = max(_NOT_AIR * measured.level, _SURE * errors[name])
        beyond = np.median(some, axis=2).mean(axis=0) > limit
        # One view alone is chance: with few photons values scatter far to one side.
        shares[name] = float(np.mean(beyond & (np.roll(beyond, 1) | np.roll(beyond, -1))))
    error = max(errors.values())
    cut = [name for name, share in shares.items() if share > _SOME_VIEWS]
    if not cut and _SURE * error > 2 * _NOT_AIR * measured.level:
        text = "the noise in the outermost columns hides what is there"
        return Finding(TRUNCATION, UNKNOWN, text, "more light", shares, error)
    if not cut:
        return Finding(TRUNCATION, OK, "air at both ends of the detector", "", shares, error)
    views = ", ".join(f"the {name} column in {100 * shares[name]:.0f} % of the views" for name in cut)
    if len(cut) == 1 and _is_offset(measured, cut[0]):
        text = f"the object reaches {views}, as it does with a detector that is offset on purpose"
        return Finding(TRUNCATION, OK, text, "", shares, error)
    remedy = "make the volume larger than the object, so that what lies outside the view has room"
    return Finding(TRUNCATION, DEFECT, f"the object reaches beyond {views}", remedy, shares, error)


def _is_offset(measured: Measured, cut: str) -> bool:
    """Whether the axis is off-centre towards the cut end, and the scan goes all the way round.

    The other end shows air in every view, so what is cut off is seen from the other side.
    """
    columns = measured.geometry.project_points(measured.axis[None])[:, 0, 0]
    middle = 0.5 * (measured.geometry.columns - 1)
    gaps = np.diff(np.sort(measured.azimuth), append=np.sort(measured.azimuth)[0] + 2 * np.pi)
    nearer = (middle - float(np.median(columns))) * (1 if cut == "first" else -1)
    return bool(nearer > _OFF_CENTRE and gaps.max() < 0.5)

"""Does the object reach beyond the detector?"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.probes.measured import Finding, Measured

__all__ = ["probe_truncation"]

# Share of the scan's large values that the outermost columns reach where there is more than air, and share of
# the views in which they must do so.
_NOT_AIR, _SOME_VIEWS = 0.06, 0.02


def probe_truncation(measured: Measured) -> Finding:
    """Look for matter in the outermost columns."""
    values = measured.filled
    width = max(1, min(3, values.shape[2] // 20))
    ends = {"first": values[..., :width], "last": values[..., -width:]}
    # The rows with most matter decide; noise is averaged over a few of them.
    shares = {}
    for name, end in ends.items():
        by_row = np.sort(np.median(end, axis=2), axis=0)
        top = by_row[-max(1, len(by_row) // 4) :].mean(axis=0)
        shares[name] = float(np.mean(top > _NOT_AIR * measured.level))
    cut = [name for name, share in shares.items() if share > _SOME_VIEWS]
    if not cut:
        return Finding("truncation", "ok", "air at both ends of the detector", "", shares)
    views = ", ".join(f"the {name} column in {100 * shares[name]:.0f} % of the views" for name in cut)
    if len(cut) == 1 and _is_offset(measured):
        text = f"the object reaches {views}, as it does with a detector that is offset on purpose"
        return Finding("truncation", "ok", text, "", shares)
    remedy = "make the volume larger than the object, so that what lies outside the view has room"
    return Finding("truncation", "defect", f"the object reaches beyond {views}", remedy, shares)


def _is_offset(measured: Measured) -> bool:
    """Whether the detector is off-centre by more than a tenth and the scan goes all the way round."""
    columns = measured.geometry.project_points(measured.axis[None])[:, 0, 0]
    middle = 0.5 * (measured.geometry.columns - 1)
    gaps = np.diff(np.sort(measured.azimuth), append=np.sort(measured.azimuth)[0] + 2 * np.pi)
    off_centre = abs(float(np.median(columns)) - middle) > 0.1 * measured.geometry.columns
    return bool(off_centre and gaps.max() < 0.5)

"""Find what is wrong with a scan, in seconds, before a reconstruction takes minutes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from tomo_polysplat.scan.probes.axes import AXES, probe_axes
from tomo_polysplat.scan.probes.beam import BEAM, probe_beam
from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding, Verdict
from tomo_polysplat.scan.probes.last_view import LAST_VIEW, probe_last_view
from tomo_polysplat.scan.probes.lengths import LENGTHS, probe_lengths
from tomo_polysplat.scan.probes.logarithm import LOGARITHM, probe_logarithm
from tomo_polysplat.scan.probes.measured import Measured
from tomo_polysplat.scan.probes.opposite import CENTRE, DIRECTION, probe_centre_and_direction
from tomo_polysplat.scan.probes.order import ORDER, probe_order
from tomo_polysplat.scan.probes.rays import DEAD, bad_rays, probe_rays
from tomo_polysplat.scan.probes.scale import SCALE, probe_scale
from tomo_polysplat.scan.probes.truncation import TRUNCATION, probe_truncation
from tomo_polysplat.scan.probes.unseen import COVERAGE, probe_coverage
from tomo_polysplat.scan.scan import Scan

__all__ = ["DEFECT", "OK", "UNKNOWN", "Finding", "Verdict", "asked", "check_scan", "nothing_to_see"]

Probe = Callable[[Measured], "Finding | list[Finding]"]
# What each probe answers, in the order in which they are asked; a defect of one of the first group would mislead the
# second.
FIRST: tuple[tuple[tuple[str, ...], Probe], ...] = (
    ((LOGARITHM,), probe_logarithm),
    ((AXES,), probe_axes),
)
LATER: tuple[tuple[tuple[str, ...], Probe], ...] = (
    ((ORDER,), probe_order),
    ((LAST_VIEW,), probe_last_view),
    ((SCALE,), probe_scale),
    ((BEAM,), probe_beam),
    ((TRUNCATION,), probe_truncation),
    ((COVERAGE,), probe_coverage),
    ((LENGTHS,), probe_lengths),
    ((CENTRE, DIRECTION), probe_centre_and_direction),
)
# Whose defects say nothing of the rest but that it is to be looked at again; those of the others hide nothing.
_MISLEADING = (LOGARITHM, AXES, ORDER)
# An object and air on both sides of it.
_FEWEST_COLUMNS = 3


def check_scan(scan: Scan) -> list[Finding]:
    """Look for the defects that scans usually have.

    Parameters
    ----------
    scan : Scan
        Nothing of its truth is used.

    Returns
    -------
    list of Finding
        On bad rays, the logarithm and its base, the order of the axes and of the views, the last view, the open beam,
        truncation, voxels that no ray sees, the unit of length, the centre and the direction of the angles. A probe
        without evidence says "unknown" and what it would take, and the others answer all the same.
    """
    measured = Measured(scan)
    kinds = bad_rays(measured)
    findings = [probe_rays(measured, kinds)]
    # The other probes look at what is left.
    measured = replace(measured, dead_pixels=np.asarray(kinds[DEAD].any(axis=1)))
    nothing = nothing_to_see(measured)
    level: Measured | None = None
    for names, probe in FIRST + LATER:
        misleading = [
            finding.probe for finding in findings if finding.probe in _MISLEADING and finding.misleading
        ]
        if nothing:
            findings += [Finding(name, UNKNOWN, nothing, "a scan of an object") for name in names]
        elif misleading and (names, probe) in LATER:
            text = f"looked for once this is mended: {', '.join(misleading)}"
            findings += [Finding(name, UNKNOWN, text, "the scan mended") for name in names]
        else:
            if level is None and (names, probe) in LATER:
                level = _level(measured)
            findings += asked(probe, names, measured if level is None or probe is probe_beam else level)
    return findings


def _level(measured: Measured) -> Measured:
    """The same less what rays beside the object tell of the open beam, as a run looks at it."""
    try:
        air = measured.air
    except ValueError:
        return measured
    return replace(measured, beam=air.level) if air is not None and air.sure else measured


def asked(probe: Probe, names: tuple[str, ...], measured: Measured) -> list[Finding]:
    """What a probe answers; where it cannot look at a scan such as this one, that it does not know."""
    try:
        answer = probe(measured)
    except ValueError as error:
        return [Finding(name, UNKNOWN, str(error)) for name in names]
    return answer if isinstance(answer, list) else [answer]


def nothing_to_see(measured: Measured) -> str:
    """Why the whole scan shows nothing, or an empty text."""
    if measured.scan.columns < _FEWEST_COLUMNS:
        return f"fewer than {_FEWEST_COLUMNS} columns do not tell"
    if not measured.valid.any():
        return "no ray is good"
    return "" if np.ptp(measured.filled) > 0 else "all rays have the same value"

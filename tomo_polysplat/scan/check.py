"""Find what is wrong with a scan, in seconds, before a reconstruction takes minutes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from tomo_polysplat.scan.probes.axes import probe_axes
from tomo_polysplat.scan.probes.logarithm import probe_logarithm
from tomo_polysplat.scan.probes.measured import Finding, Measured
from tomo_polysplat.scan.probes.opposite import CENTRE, DIRECTION, probe_centre_and_direction
from tomo_polysplat.scan.probes.order import probe_order
from tomo_polysplat.scan.probes.rays import DEAD, bad_rays, probe_rays
from tomo_polysplat.scan.probes.truncation import probe_truncation
from tomo_polysplat.scan.scan import Scan

__all__ = ["Finding", "check_scan"]

LATER: tuple[tuple[tuple[str, ...], Callable[[Measured], list[Finding]]], ...] = (
    (("order of views",), lambda measured: [probe_order(measured)]),
    (("truncation",), lambda measured: [probe_truncation(measured)]),
    ((CENTRE, DIRECTION), probe_centre_and_direction),
)


# An object and air on both sides of it.
_FEWEST_COLUMNS = 3


def check_scan(scan: Scan) -> list[Finding]:
    """Look for the defects that scans usually have.

    Parameters
    ----------
    scan : Scan
        Nothing of its truth, spectrum or volume is used.

    Returns
    -------
    list of Finding
        On the logarithm, the order of the axes and of the views, bad rays, truncation, the centre and the
        direction of the angles. A defect that would mislead a later probe makes that one "unknown".
    """
    measured = Measured(scan)
    kinds = bad_rays(measured)
    rays = probe_rays(measured, kinds)
    # The other probes look at what is left.
    measured = Measured(scan, dead_pixels=np.asarray(kinds[DEAD].any(axis=1)))
    nothing = _nothing_to_see(measured)
    if nothing:
        names = ("logarithm", "order of axes", *(name for names, _ in LATER for name in names))
        return [rays, *(Finding(name, "unknown", nothing) for name in names)]
    findings = [rays, probe_logarithm(measured), probe_axes(measured)]
    for names, probe in LATER:
        misleading = [finding.probe for finding in findings[1:] if finding.misleading]
        if misleading:
            text = f"looked for once this is mended: {', '.join(misleading)}"
            findings += [Finding(name, "unknown", text) for name in names]
        else:
            findings += probe(measured)
    return findings


def _nothing_to_see(measured: Measured) -> str:
    """Why the whole scan shows nothing, or an empty text."""
    if measured.scan.columns < _FEWEST_COLUMNS:
        return f"fewer than {_FEWEST_COLUMNS} columns do not tell"
    if not measured.valid.any():
        return "no ray is good"
    return "" if np.ptp(measured.filled) > 0 else "all rays have the same value"

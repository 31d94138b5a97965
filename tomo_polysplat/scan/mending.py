"""What `check` is sure of, mended: for `recon` and `reconstruct`, which say what was done."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np

from tomo_polysplat.scan.check import DEFECT, Finding, asked, check_scan, nothing_to_see
from tomo_polysplat.scan.layout import vector_form
from tomo_polysplat.scan.probes.measured import Measured
from tomo_polysplat.scan.probes.opposite import CENTRE, DIRECTION, probe_centre_and_direction
from tomo_polysplat.scan.scan import Scan

__all__ = ["mend_scan"]

logger = logging.getLogger(__name__)

# Whose defects leave nothing sure about the axis.
_GRAVE = (DIRECTION, "logarithm", "order of axes", "order of views")
# An axis is moved that is known to this standard error, in columns.
_SURE_OF_AXIS = 0.1


def mend_scan(scan: Scan, findings: list[Finding] | None = None) -> tuple[Scan, list[str]]:
    """The scan with the rotation axis where the rays have it, where that is beyond doubt.

    Parameters
    ----------
    scan : Scan
        It is not changed, and neither are its arrays.
    findings : list of Finding, optional
        Those of :func:`~tomo_polysplat.scan.check.check_scan`, where they are known.

    Returns
    -------
    Scan
        The same object where nothing is to be done.
    list of str
        What was done, a sentence each.
    """
    if findings is None:
        measured = Measured(scan)
        # One question first, which is quick: most scans are good.
        findings = check_scan(scan) if _axis_looks_off(measured) else []
    if any(finding.probe != CENTRE and finding.misleading for finding in findings if finding.probe in _GRAVE):
        return scan, []
    for finding in findings:
        if _is_sure(finding):
            offset = finding.values["offset"]
            geometry = dict(vector_form(scan.proj_geom))
            vectors = np.array(geometry["Vectors"], np.float64)
            vectors[:, 3:6] -= offset * vectors[:, 6:9]
            geometry["Vectors"] = vectors
            done = (
                f"the detector was moved by {-offset:.2f} columns (standard error {finding.uncertainty:.2g})"
            )
            logger.warning("%s: %s; mend=False or --no-mend leaves it.", done.capitalize(), finding.text)
            return replace(scan, proj_geom=geometry), [f"{done}: {finding.text}"]
    return scan, []


def _is_sure(finding: Finding) -> bool:
    """Whether it is an axis that is off, and known well."""
    known = finding.uncertainty is not None and finding.uncertainty <= _SURE_OF_AXIS
    return finding.probe == CENTRE and finding.verdict == DEFECT and known


def _axis_looks_off(measured: Measured) -> bool:
    """What `check_scan` asks of the axis, without the questions before."""
    looks_off = any(map(_is_sure, asked(probe_centre_and_direction, (CENTRE, DIRECTION), measured)))
    # Rows of the whole scan are read for it, which takes longer.
    return looks_off and not nothing_to_see(measured)

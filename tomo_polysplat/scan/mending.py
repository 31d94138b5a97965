"""What `check` is sure of, mended: for `recon` and `reconstruct`, which say what was done."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tomo_polysplat.scan.check import DEFECT, Finding, check_scan
from tomo_polysplat.scan.layout import vector_form
from tomo_polysplat.scan.scan import Scan

__all__ = ["mend_scan"]

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
    for finding in check_scan(scan) if findings is None else findings:
        sure = finding.uncertainty is not None and finding.uncertainty <= _SURE_OF_AXIS
        if finding.probe == "centre" and finding.verdict == DEFECT and sure:
            offset = finding.values["offset"]
            geometry = dict(vector_form(scan.proj_geom))
            vectors = np.array(geometry["Vectors"], np.float64)
            vectors[:, 3:6] -= offset * vectors[:, 6:9]
            geometry["Vectors"] = vectors
            done = (
                f"the detector was moved by {-offset:.2f} columns (standard error {finding.uncertainty:.2g})"
            )
            return replace(scan, proj_geom=geometry), [f"{done}: {finding.text}"]
    return scan, []

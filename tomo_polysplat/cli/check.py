"""``tomo-polysplat check``: what a scan file holds, and what is wrong with it."""

from __future__ import annotations

import argparse

from tomo_polysplat.checks import visible
from tomo_polysplat.cli.options import add_scan_options

NAME = "check"
HELP = "say what is in a scan and what is wrong with it, and how to mend that"
DEFECT_STATUS = 3
SIGNS = {"ok": "ok", "defect": "MEND", "unknown": "?"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    add_scan_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read, describe and check a file; the exit status is 3 if something should be mended."""
    import numpy as np

    from tomo_polysplat.cli.options import scan_from
    from tomo_polysplat.scan.check import check_scan
    from tomo_polysplat.scan.geometry import from_astra

    scan = scan_from(arguments)
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    values = scan.projections if scan.valid is None else scan.projections[scan.valid]
    lost = 0 if scan.valid is None else int(np.count_nonzero(~scan.valid))
    size = " x ".join(f"{length:.4g}" for length in grid.voxel_size)
    lines = {
        "scan": repr(scan),
        "geometry": geometry.describe(),
        "voxel": f"{size} {scan.unit} (x, y, z)",
        "spectrum": "unknown: pass --kvp or --spectrum to recon"
        if scan.spectrum is None
        else repr(scan.spectrum),
        "line integrals": f"{values.min():.3g} to {values.max():.3g}, median {np.median(values):.3g}"
        if values.size
        else "none that is good",
        "rays left out": f"{lost} of {scan.projections.size}",
        "truth": "none" if scan.truth is None else f"largest value {scan.truth.max():.3g} 1/{scan.unit}",
    }
    if "centre" in scan.notes:
        how = "estimated from opposite views" if scan.notes["centre_estimated"] else "as given"
        lines["rotation axis"] = f"column {scan.notes['centre']:.2f}, {how}"
    width = max(map(len, lines))
    for name, text in lines.items():
        print(f"{name:{width}}  {visible(text)}")
    findings = check_scan(scan)
    print()
    width = max(len(finding.probe) for finding in findings)
    for finding in findings:
        print(f"{SIGNS[finding.verdict]:4}  {finding.probe:{width}}  {visible(finding.text)}")
        if finding.remedy:
            print(f"{'':4}  {'':{width}}  -> {visible(finding.remedy)}")
    return DEFECT_STATUS if any(finding.verdict == "defect" for finding in findings) else 0

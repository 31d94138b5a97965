"""``tomo-polysplat check``: what a scan file holds, and what is wrong with it."""

from __future__ import annotations

import argparse
import time
from dataclasses import replace
from typing import TYPE_CHECKING

from tomo_polysplat.checks import visible
from tomo_polysplat.cli.options import add_scan_options

if TYPE_CHECKING:
    from tomo_polysplat.scan.scan import Scan

NAME = "check"
HELP = "say what is in a scan and what is wrong with it, and how to mend that"
DEFECT_STATUS = 3
# Rays of a large file that the range of line integrals is told of.
_LOOKED_AT = 1 << 27
SIGNS = {"ok": "ok", "defect": "MEND", "unknown": "?"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    add_scan_options(parser)
    parser.add_argument(
        "--time",
        action="store_true",
        help="say what recon will take on this machine: makes the start and times some steps",
    )
    parser.add_argument("--device", default="auto", help="with --time: auto (default), cpu, cuda or cuda:N")


def run(arguments: argparse.Namespace) -> int:
    """Read, describe and check a file; the exit status is 3 if something should be mended."""
    from tomo_polysplat.cli.options import scan_from
    from tomo_polysplat.scan.check import check_scan

    scan = scan_from(arguments)
    lines = _described(scan)
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
    defects, unknown = (
        sum(finding.verdict == verdict for finding in findings) for verdict in ("defect", "unknown")
    )
    print(f"\n{_summary(defects, unknown)}")
    if arguments.time:
        print(f"\nrecon  {_expected(scan, arguments.device)}")
    return DEFECT_STATUS if defects else 0


def _described(scan: Scan) -> dict[str, str]:
    """What the file holds, a line each."""

    from tomo_polysplat.scan.geometry import from_astra

    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    lost, values = _good_values(scan)
    size = " x ".join(f"{length:.4g}" for length in grid.voxel_size)
    lines = {
        "scan": repr(scan),
        "geometry": geometry.describe(),
        "voxel": f"{size} {scan.unit} (x, y, z)",
        "spectrum": "unknown: pass --kvp or --spectrum to recon"
        if scan.spectrum is None
        else repr(scan.spectrum),
        "line integrals": values,
        "rays left out": f"{lost} of {scan.projections.size}",
        "truth": "none" if scan.truth is None else f"largest value {scan.truth.max():.3g} 1/{scan.unit}",
    }
    if "centre" in scan.notes:
        how = "estimated from opposite views" if scan.notes["centre_estimated"] else "as given"
        lines["rotation axis"] = f"column {scan.notes['centre']:.2f}, {how}"
    return lines


def _good_values(scan: Scan) -> tuple[int, str]:
    """How many rays are not good, and the range and the median of the others; that of some views of a large file."""
    import numpy as np

    from tomo_polysplat.scan.counts import Counts

    some = slice(None)
    if isinstance(scan.projections, Counts):
        some = slice(None, None, -(-scan.views // max(1, _LOOKED_AT // (scan.rows * scan.columns))))
    values = scan.projections[:, some]
    lost = 0
    if scan.valid is not None:
        good = scan.valid[:, some]
        lost, values = int(np.count_nonzero(~good)), values[good]
    if isinstance(scan.projections, Counts) and scan.projections.found is not None:
        lost = sum(scan.projections.found.values())
    of = "" if some.step in (None, 1) else f" (every {some.step}th view)"
    if not values.size:
        return lost, "none that is good"
    return lost, f"{values.min():.3g} to {values.max():.3g}, median {np.median(values):.3g}{of}"


def _summary(defects: int, unknown: int) -> str:
    """What to do about all of the answers, in a sentence or two."""
    text = f"Mend {defects} of them before recon." if defects else "Nothing to mend: recon can begin."
    if unknown:
        text += f" This scan cannot answer {unknown} of the questions; that alone is no fault."
    return text


def _expected(scan: Scan, device: str) -> str:
    """What a reconstruction will take, in words."""
    from tomo_polysplat.plan.expected import only_told
    from tomo_polysplat.reconstruction import reconstruct

    # As recon asks it.
    spectrum = None if scan.unit == "pixel" else scan.spectrum
    begun = time.perf_counter()
    with only_told() as found:
        reconstruct(replace(scan, spectrum=spectrum), device=device, progress=False)
    return found[0].describe() if found else f"{time.perf_counter() - begun:.2g} s in all: it was run"

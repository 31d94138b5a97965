"""``tomo-polysplat view``: results in the browser of this machine."""

from __future__ import annotations

import argparse
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tomo_polysplat.checks import fail, visible
from tomo_polysplat.files import existing_file

if TYPE_CHECKING:
    from tomo_polysplat.result.result import Result
    from tomo_polysplat.viewer.volumes import Shown

# How such a file begins.
_HDF5 = b"\x89HDF\r\n\x1a\n"
NAME = "view"
HELP = "look at results in the browser: linked slices, before and after, residuals, what was decided"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    parser.add_argument("result", metavar="RESULT", help=".h5 that recon has written")
    parser.add_argument("others", nargs="*", metavar="OTHER", help="more of them, to stand beside it")
    parser.add_argument(
        "--scan",
        metavar="SCAN",
        help="what it was made from: adds FDK, the truth if there is one, and residuals",
    )
    parser.add_argument("--port", type=int, default=0, help="port on 127.0.0.1 (default: any that is free)")
    parser.add_argument("--no-browser", action="store_true", help="print the address instead of opening it")


def run(arguments: argparse.Namespace) -> int:
    """Serve the page until Ctrl-C."""
    from tomo_polysplat.viewer.server import Server

    if not 0 <= arguments.port <= 65535:
        raise fail("--port", "a number from 0 to 65535", arguments.port)
    with Server(shown_by(arguments), arguments.port) as server:
        print(f"{server.url}\nCtrl-C ends it.", flush=True)
        if not arguments.no_browser:
            webbrowser.open(server.url)
        try:
            server.serve_forever()
        except KeyboardInterrupt:
            print()
    return 0


def shown_by(arguments: argparse.Namespace) -> Shown:
    """What the files hold, as the page shows it."""
    from tomo_polysplat.report.html import of_scan, title_of, told
    from tomo_polysplat.scan.io import load_scan
    from tomo_polysplat.viewer.volumes import shown_of

    result = _loaded(arguments.result)
    residuals = result.residuals
    others: dict[str, Any] = {_name(path): _loaded(path) for path in arguments.others}
    if len(others) < len(arguments.others):
        raise fail("OTHER", "files of different names", "two of one name")
    scan = None if arguments.scan is None else load_scan(arguments.scan, unit=result.unit)
    if scan is not None:
        residuals, beside = of_scan(result, scan)
        others = dict(beside) | others | ({} if scan.truth is None else {"truth": scan.truth})
    return shown_of(result, others, title_of(result, scan), "\n".join(told(result, residuals)))


def _loaded(path: str) -> Result:
    from tomo_polysplat.result.result import Result

    with open(existing_file(path, "RESULT"), "rb") as stream:
        start = stream.read(8)
    if start != _HDF5:
        remedy = "`recon SCAN -o RESULT.h5` writes what is shown here; look at a TIFF in ImageJ"
        raise fail("RESULT", "the .h5 that recon has written", f"{path}, a file of another kind", remedy)
    return Result.load(path)


def _name(path: str) -> str:
    return visible(Path(path).stem)

"""``tomo-polysplat import``: from a scanner's folder to one file with all that is known of the scan."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from tomo_polysplat.checks import fail, visible
from tomo_polysplat.cli.options import (
    add_scan_options,
    add_spectrum_options,
    scan_from,
    spectrum_from,
    tube_of_scanner,
)
from tomo_polysplat.files import require_replaceable, require_writable

NAME = "import"
HELP = "read a scanner's folder (or file) and write it as one scan with geometry and spectrum"
EXAMPLES = (
    "tomo-polysplat import my_scan/ -o scan.h5",
    "tomo-polysplat import tiffs/ --sod 200 --sdd 500 --pixel 0.1 --angles 360 --kvp 90 --filter 'Al 1mm' -o scan.h5",
    "tomo-polysplat import aps.h5 --sod 200 --sdd 500 --pixel 0.1 -o scan.h5",
)
# Option and the name of `scanner` in `load_scan` that it stands for.
LENGTHS = {"sod": "source_object", "sdd": "source_detector"}
# What one, two and three whole numbers look like.
_COUNTED = (("a number", "2"), ("A:B", "100:900"), ("A:B:N", "0:900:2"))
TEXTS = {"projections": "projections", "flat": "flats", "dark": "darks"}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    add_scan_options(parser)
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=".h5 (Data Exchange) or .npz")
    parser.add_argument("--overwrite", action="store_true", help="replace a file that exists")
    group = parser.add_argument_group("how much to read")
    for name in ("rows", "columns"):
        group.add_argument(f"--{name}", metavar="A:B", help=f"{name} A to B - 1, from 0 at the top left")
    group.add_argument("--views", metavar="N", help="every N-th view, or A:B or A:B:N")
    group.add_argument("--binning", type=int, default=1, metavar="N", help="average N x N pixels")
    group = parser.add_argument_group("what no file says (lengths in --unit, mm unless told)")
    group.add_argument("--sod", type=float, metavar="LENGTH", help="from the source to the rotation axis")
    group.add_argument("--sdd", type=float, metavar="LENGTH", help="from the source to the detector")
    group.add_argument("--pixel", type=float, metavar="LENGTH", help="side of a pixel of the detector")
    group.add_argument(
        "--offset",
        nargs=2,
        type=float,
        metavar=("RIGHT", "UP"),
        help="the detector's middle from the foot of the ray through the axis",
    )
    group.add_argument(
        "--angles", metavar="FILE|ARC", help="text file with a view's degrees a line, or the whole arc (360)"
    )
    group.add_argument("--parallel", action="store_true", help="a parallel beam: no distances")
    group.add_argument(
        "--projections",
        metavar="PATTERN",
        help="of the object's pictures, such as 'proj_*.tif'",
    )
    group.add_argument("--flat", metavar="PATTERN", help="pictures without the object")
    group.add_argument("--dark", metavar="PATTERN", help="pictures without light")
    group.add_argument("--white", type=float, metavar="COUNTS", help="the open beam where there are no flats")
    add_spectrum_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Read and write."""
    from tomo_polysplat.scan.io import require_scan_name, save_scan

    output = Path(arguments.output)
    require_scan_name(output, "--output")
    require_replaceable(output, arguments.overwrite, "pass --overwrite", "--output")
    require_writable(output.parent, "--output")
    stated = _stated(arguments)
    scan = scan_from(
        arguments,
        spectrum_from(arguments),
        scanner=stated or None,
        rows=_numbers("--rows", arguments.rows, 2),
        columns=_numbers("--columns", arguments.columns, 2),
        views=_views(arguments.views),
        binning=arguments.binning,
    )
    save_scan(scan, output, overwrite=arguments.overwrite)
    print(visible(scan))
    print(f"wrote {visible(output)}")
    return 0


def _stated(arguments: argparse.Namespace) -> dict[str, Any]:
    """What stands for `scanner` of `load_scan`, the options of the tube among it, which then are none of a spectrum."""
    names = {**LENGTHS, **TEXTS, "pixel": "pixel", "offset": "offset", "white": "white"}
    stated = {key: getattr(arguments, name) for name, key in names.items()}
    if arguments.parallel:
        stated["beam"] = "parallel"
    if arguments.angles is not None:
        try:
            stated["arc"] = float(arguments.angles)
        except ValueError:
            stated["degrees"] = arguments.angles
    stated = {key: value for key, value in stated.items() if value is not None}
    return stated | tube_of_scanner(arguments, stated)


def _views(text: str | None) -> Any:
    if text is None or ":" not in text:
        return None if text is None else _numbers("--views", text, 1)[0]
    return _numbers("--views", text, 3 if text.count(":") == 2 else 2)


def _numbers(option: str, text: str | None, count: int) -> Any:
    """Whole numbers that colons stand between."""
    if text is None:
        return None
    parts = text.split(":")
    if len(parts) != count or not all(part.isdecimal() for part in parts):
        expected, such = _COUNTED[count - 1]
        raise fail(option, expected, repr(text), f"whole numbers with colons between them, such as {such}")
    return tuple(int(part) for part in parts)

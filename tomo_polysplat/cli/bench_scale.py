"""``tomo-polysplat bench scale``: cost and error by size, on structures with detail everywhere."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["add_parser", "scale"]


def add_parser(what: Any) -> argparse.ArgumentParser:
    """The parser of the command."""
    parser = what.add_parser("scale", help="bone, foam and grains of growing size: seconds, bytes and errors")
    parser.add_argument("--device", default="auto", help="auto (default), cpu, cuda or cuda:N")
    parser.add_argument("--kinds", nargs="+", default=["bone", "foam", "grains"], help="default: all three")
    parser.add_argument(
        "--sizes",
        nargs="+",
        type=int,
        default=[96],
        help="voxels per edge, as 96 192 400 768 1024 (default: 96)",
    )
    parser.add_argument(
        "--metal", choices=["with", "without", "both"], default="with", help="a screw (default: with)"
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="METHOD",
        default=["fdk", "fdk-water", "voxel-poly", "polysplat"],
        help="as of bench recon (default: fdk fdk-water voxel-poly polysplat)",
    )
    parser.add_argument("--seeds", type=int, default=1, help="repetitions with other objects (default: 1)")
    parser.add_argument(
        "--views", type=int, help="projection images (default: 1.5 times the voxels per edge)"
    )
    parser.add_argument(
        "--columns", type=int, help="pixels along an edge of the detector (default: as views)"
    )
    parser.add_argument(
        "--feature", type=float, default=6.0, help="width of the detail in voxels (default: 6)"
    )
    parser.add_argument("--photons", type=float, default=5e4, help="counts of a free ray (default: 5e4)")
    parser.add_argument(
        "--passes", type=float, metavar="N", help="passes over the views, instead of the default"
    )
    return parser


def scale(
    arguments: argparse.Namespace,
    write: Callable[..., None],
    write_text: Callable[..., None],
    say: Callable[[str], None],
) -> int:
    """``bench scale``; ``write`` and ``write_text`` keep a record, ``say`` tells what comes next."""
    from tomo_polysplat.bench.scale import ScaleBench, run_scale_bench
    from tomo_polysplat.bench.scale_report import as_markdown, as_text, write_figure

    names = ("kinds", "sizes", "methods", "seeds", "views", "columns", "feature", "photons", "device")
    chosen = {name: getattr(arguments, name) for name in names}
    metal = {"with": (True,), "without": (False,), "both": (True, False)}[arguments.metal]
    settings = {} if arguments.passes is None else {"passes": arguments.passes}
    record = run_scale_bench(
        ScaleBench(**chosen, metal=metal, settings=settings),
        progress=say,
        update=lambda so_far: write(arguments, "scale.json", so_far, quiet=True),
    )
    print(as_text(record))
    write(arguments, "scale.json", record)
    write_text(arguments, "scale.md", as_markdown(record))
    if arguments.record:
        write_figure(Path(arguments.record) / "scale.png", record)
    return 0 if all(run["seconds"] is not None or "skipped" in run["about"] for run in record["runs"]) else 1

"""``tomo-polysplat demo``: the four methods on one simulated scan."""

from __future__ import annotations

import argparse
from pathlib import Path

from tomo_polysplat.cli.options import ProgressBar, add_solver_options

NAME = "demo"
HELP = "simulate a scan with metal, reconstruct it four ways, and write demo.png, demo.h5 and demo.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    parser.add_argument(
        "-o",
        "--output",
        default=".",
        metavar="FOLDER",
        help="where to write; its own files are replaced (default: .)",
    )
    add_solver_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run it and print its table."""
    from tomo_polysplat.bench.demo import run_demo
    from tomo_polysplat.report.table import as_text

    folder = Path(arguments.output)
    folder.mkdir(parents=True, exist_ok=True)
    with ProgressBar() as progress:
        outcome = run_demo(folder, device=arguments.device, seed=arguments.seed, progress=progress)
    print(as_text(outcome["methods"], "cm"))
    for name in ("demo.png", "demo.h5", "demo.json"):
        print(f"wrote {folder / name}")
    return 0

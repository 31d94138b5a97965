"""``tomo-polysplat demo``: the four methods on one simulated scan."""

from __future__ import annotations

import argparse
from pathlib import Path

from tomo_polysplat.checks import visible
from tomo_polysplat.cli.options import add_solver_options
from tomo_polysplat.files import require_replaceable, require_writable
from tomo_polysplat.progress import progress_reports

NAME = "demo"
HELP = "simulate a scan with metal, reconstruct it four ways, and write demo.png, demo.h5 and demo.json"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    parser.add_argument(
        "-o",
        "--output",
        default=".",
        metavar="FOLDER",
        help="where to write (default: .)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files that exist")
    add_solver_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run it and print its table."""
    from tomo_polysplat.bench.demo import FILES, run_demo
    from tomo_polysplat.kernels.ahead import compiled_ahead
    from tomo_polysplat.report.table import as_text

    folder = Path(arguments.output)
    folder.mkdir(parents=True, exist_ok=True)
    for name in FILES:
        require_replaceable(
            folder / name, arguments.overwrite, "pass --overwrite or another folder", "--output"
        )
    require_writable(folder, "--output")
    with progress_reports(None) as progress, compiled_ahead(arguments.device):
        outcome = run_demo(folder, device=arguments.device, seed=arguments.seed, progress=progress)
    print(as_text(outcome["methods"], "cm"))
    for name in FILES:
        print(f"wrote {visible(folder / name)}")
    return 0

"""``tomo-polysplat bench``: methods against each other on the simulated scenes."""

from __future__ import annotations

import argparse
from pathlib import Path

from tomo_polysplat.cli.options import ProgressBar, add_solver_options, write_json
from tomo_polysplat.files import require_replaceable

NAME = "bench"
HELP = "compare methods on simulated scenes and write seconds and errors as JSON"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    parser.add_argument("-o", "--output", default="bench.json", metavar="FILE", help="default: bench.json")
    parser.add_argument("--overwrite", action="store_true", help="replace a file that exists")
    parser.add_argument(
        "--scenes", nargs="+", default=["pins", "teeth"], metavar="SCENE", help="default: pins teeth"
    )
    parser.add_argument("--size", type=int, default=64, help="voxels per edge (default: 64)")
    parser.add_argument("--views", type=int, default=180, help="projection images (default: 180)")
    add_solver_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run it, and print a table for each scene."""
    from tomo_polysplat.bench.run import run_bench
    from tomo_polysplat.report.table import as_text

    output = Path(arguments.output)
    require_replaceable(output, arguments.overwrite)
    with ProgressBar() as progress:
        outcome = run_bench(
            arguments.scenes,
            size=arguments.size,
            views=arguments.views,
            device=arguments.device,
            seed=arguments.seed,
            progress=progress,
        )
    for scene, methods in outcome["scenes"].items():
        print(f"\n{scene}\n{as_text(methods, 'cm')}")
    write_json(output, outcome, overwrite=arguments.overwrite)
    print(f"wrote {output}")
    return 0

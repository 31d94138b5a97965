"""``tomo-polysplat bench plan``: what the plan's decisions save."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

__all__ = ["add_parser", "plan"]


def add_parser(what: Any) -> argparse.ArgumentParser:
    """The parser of the command."""
    parser = what.add_parser("plan", help="seconds and errors with each of the plan's decisions, and without")
    parser.add_argument("--device", default="auto", help="auto (default), cpu, cuda or cuda:N")
    parser.add_argument("--scans", nargs="+", metavar="NAME", help="these scans, quoted (default: all four)")
    parser.add_argument("--size", type=int, default=36, help="voxels along the scene (default: 36)")
    parser.add_argument("--views", type=int, default=72, help="projection images (default: 72)")
    parser.add_argument("--seed", type=int, default=0, help="of noise and solver (default: 0)")
    parser.add_argument(
        "--again",
        type=int,
        default=4,
        metavar="N",
        help="scans of other noise for variants that are ahead of the plan (default: 4)",
    )
    return parser


def plan(
    arguments: argparse.Namespace,
    write: Callable[..., None],
    write_text: Callable[..., None],
    say: Callable[[str], None],
) -> int:
    """``bench plan``; ``write`` and ``write_text`` keep a record, ``say`` tells what comes next."""
    from tomo_polysplat.bench.plan import PlanBench, run_plan_bench
    from tomo_polysplat.bench.plan_report import as_markdown, write_figure

    chosen = {name: getattr(arguments, name) for name in ("size", "views", "device", "seed", "again")}
    if arguments.scans:
        chosen["scans"] = tuple(arguments.scans)
    record = run_plan_bench(
        PlanBench(**chosen),
        progress=say,
        update=lambda so_far: write(arguments, "plan.json", so_far, quiet=True),
    )
    table = as_markdown(record)
    print(table)
    write(arguments, "plan.json", record)
    write_text(arguments, "plan.md", table)
    if arguments.record:
        write_figure(Path(arguments.record) / "plan-stopping.png", record)
    return 0 if all(run["seconds"] is not None for run in record["runs"]) else 1

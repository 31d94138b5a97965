"""``tomo-polysplat bench``: kernels, and whole reconstructions by several methods, timed with their errors."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tomo_polysplat.cli.options import add_solver_options, write_json

if TYPE_CHECKING:
    from tomo_polysplat.bench.recon import ReconBench

NAME = "bench"
HELP = "time kernels, or whole reconstructions by several methods, together with their errors"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Its own subcommands and their options."""
    what = parser.add_subparsers(metavar="WHAT", dest="what", required=True)
    kernels = what.add_parser("kernels", help="pixel-Gaussian pairs a second, after a check of the result")
    kernels.add_argument("--device", default="auto", help="auto (default), cpu, cuda or cuda:N")
    kernels.add_argument("--kernel", default="auto", help="auto (default), triton, numba or reference")
    kernels.add_argument("--repeats", type=int, default=5, help="the shortest of so many counts (default: 5)")
    recon = what.add_parser("recon", help="scenes x sizes x methods x time budgets")
    _add_recon_arguments(recon)
    for child in (kernels, recon):
        child.add_argument(
            "--record",
            metavar="FOLDER",
            help="also write JSON (and figures) there, replacing its own earlier files",
        )


def _add_recon_arguments(parser: argparse.ArgumentParser) -> None:
    add_solver_options(parser)
    parser.add_argument("--scenes", nargs="+", default=["pins", "teeth"], help="default: pins teeth")
    parser.add_argument("--sizes", nargs="+", type=int, default=[64], help="voxels per edge (default: 64)")
    parser.add_argument("--views", type=int, default=180, help="projection images (default: 180)")
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="METHOD",
        default=["fdk", "fdk-water", "sirt", "limar", "nmar", "voxel-poly", "mono", "polysplat"],
        help="among fdk fdk-water sirt sirt-200 limar nmar voxel-poly mono polysplat (default: all but sirt-200)",
    )
    parser.add_argument(
        "--budgets",
        nargs="+",
        type=float,
        default=[],
        metavar="SECONDS",
        help="for methods that improve with time (default: until they stop by themselves)",
    )
    parser.add_argument("--photons", type=float, default=1e5, help="counts of a free ray (default: 1e5)")
    parser.add_argument("--kvp", type=float, default=90.0, help="tube voltage, behind 1 mm Al (default: 90)")
    parser.add_argument(
        "--no-curves", action="store_true", help="leave out the runs that are watched as they go"
    )
    parser.add_argument("--cache", metavar="FOLDER", help="simulated scans (default: among temporary files)")


def run(arguments: argparse.Namespace) -> int:
    """Run the benchmark that was named and print its table."""
    if arguments.record:
        Path(arguments.record).mkdir(parents=True, exist_ok=True)
    arguments.device = _device(arguments.device)
    return _kernels(arguments) if arguments.what == "kernels" else _recon(arguments)


def _device(name: str) -> str:
    if name != "auto":
        return name
    import torch

    return "cuda" if torch.cuda.is_available() else "cpu"


def _kernels(arguments: argparse.Namespace) -> int:
    from tomo_polysplat.bench.environment import environment
    from tomo_polysplat.bench.kernels import as_text, bench_kernels

    records = bench_kernels(arguments.device, kernel=arguments.kernel, repeats=arguments.repeats)
    print(as_text(records))
    _write(arguments, "kernels.json", {"environment": environment(), "kernels": records})
    return 0 if all(record["correct"] for record in records) else 1


def _recon(arguments: argparse.Namespace) -> int:
    from tomo_polysplat.bench.recon import run_recon_bench
    from tomo_polysplat.bench.recon_report import as_text, write_figures

    cache = None
    if arguments.cache:
        cache = Path(arguments.cache)
        cache.mkdir(parents=True, exist_ok=True)
    record = run_recon_bench(
        _recon_bench(arguments),
        cache=cache,
        progress=lambda words: print(words, file=sys.stderr, flush=True),
        update=lambda so_far: _write(arguments, "recon.json", so_far, quiet=True),
    )
    print(as_text(record))
    _write(arguments, "recon.json", record)
    if arguments.record:
        for path in write_figures(Path(arguments.record), record):
            print(f"wrote {path}")
    return 0 if all(entry["seconds"] is not None for entry in record["runs"]) else 1


def _recon_bench(arguments: argparse.Namespace) -> ReconBench:
    from tomo_polysplat.bench.recon import ReconBench

    names = ("scenes", "sizes", "methods", "views", "budgets", "device", "seed", "photons", "kvp")
    return ReconBench(**{name: getattr(arguments, name) for name in names}, curves=not arguments.no_curves)


def _write(arguments: argparse.Namespace, name: str, content: dict[str, Any], *, quiet: bool = False) -> None:
    """Write a record with the command that made it."""
    if arguments.record is None:
        return
    path = Path(arguments.record) / name
    command = " ".join(["tomo-polysplat", *sys.argv[1:]])
    write_json(path, {"command": command, **content}, overwrite=True)
    if not quiet:
        print(f"wrote {path}")

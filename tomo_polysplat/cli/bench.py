"""``tomo-polysplat bench``: kernels, reconstructions, their accuracy, the solver's parts, and hard cases."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tomo_polysplat.cli import bench_physics, bench_plan, bench_scale
from tomo_polysplat.cli.options import add_solver_options
from tomo_polysplat.files import write_text
from tomo_polysplat.result.files import write_json

if TYPE_CHECKING:
    from tomo_polysplat.bench.recon import ReconBench

NAME = "bench"
HELP = "time kernels, or whole reconstructions by several methods, together with their errors"

_METHODS = ["fdk", "fdk-water", "sirt", "limar", "nmar", "voxel-poly", "mono", "polysplat"]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Its own subcommands and their options."""
    what = parser.add_subparsers(metavar="WHAT", dest="what", required=True)
    kernels = what.add_parser("kernels", help="pixel-Gaussian pairs a second, after a check of the result")
    kernels.add_argument("--device", default="auto", help="auto (default), cpu, cuda or cuda:N")
    kernels.add_argument("--kernel", default="auto", help="auto (default), triton, numba or reference")
    kernels.add_argument("--repeats", type=int, default=5, help="the shortest of so many counts (default: 5)")
    recon = what.add_parser("recon", help="scenes x sizes x methods x time budgets")
    _add_recon_arguments(recon)
    accuracy = what.add_parser(
        "accuracy", help="errors of many kinds, over seeds, noise, views and tube voltages"
    )
    _add_accuracy_arguments(accuracy)
    ablation = what.add_parser("ablation", help="seconds and errors with parts of the solver changed")
    _add_ablation_arguments(ablation)
    hard = what.add_parser("hard", help="cases at the limits, each with what must come of it")
    hard.add_argument("--device", default="auto", help="auto (default), cpu, cuda or cuda:N")
    hard.add_argument("--only", nargs="+", default=[], metavar="NAME", help="these cases (default: all)")
    spectrum, materials = bench_physics.add_parsers(what)
    plan = bench_plan.add_parser(what)
    scale = bench_scale.add_parser(what)
    for child in (kernels, recon, accuracy, ablation, hard, spectrum, materials, plan, scale):
        child.add_argument(
            "--record",
            metavar="FOLDER",
            help="also write JSON (and figures) there, replacing its own earlier files",
        )


def _add_recon_arguments(parser: argparse.ArgumentParser) -> None:
    add_solver_options(parser)
    _add_comparison_arguments(parser)
    parser.add_argument("--views", type=int, default=180, help="projection images (default: 180)")
    parser.add_argument("--photons", type=float, default=1e5, help="counts of a free ray (default: 1e5)")
    parser.add_argument("--kvp", type=float, default=90.0, help="tube voltage, behind 1 mm Al (default: 90)")


def _add_accuracy_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", default="auto", help="auto (default), cpu, cuda or cuda:N")
    _add_comparison_arguments(parser)
    parser.add_argument("--seeds", type=int, default=1, help="repetitions with other noise (default: 1)")
    for name, kind, standard, words in (
        ("--views", int, 180, "projection images"),
        ("--photons", float, 1e5, "counts of a free ray"),
        ("--kvp", float, 90.0, "tube voltages, behind 1 mm Al"),
    ):
        parser.add_argument(
            name, nargs="+", type=kind, default=[standard], help=f"{words} (default: {standard:g})"
        )
    _add_settings_argument(parser)


def _add_ablation_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", default="auto", help="auto (default), cpu, cuda or cuda:N")
    parser.add_argument("--scenes", nargs="+", default=["pins", "teeth"], help="default: pins teeth")
    parser.add_argument("--size", type=int, default=64, help="voxels per edge (default: 64)")
    parser.add_argument("--views", type=int, default=180, help="projection images (default: 180)")
    parser.add_argument("--photons", type=float, default=1e5, help="counts of a free ray (default: 1e5)")
    parser.add_argument("--kvp", type=float, default=90.0, help="tube voltage, behind 1 mm Al (default: 90)")
    parser.add_argument("--seeds", type=int, default=1, help="repetitions with other noise (default: 1)")
    parser.add_argument(
        "--groups",
        nargs="+",
        metavar="GROUP",
        help="among components nodes curve free weights blur relocation affine (default: all)",
    )
    parser.add_argument("--cache", metavar="FOLDER", help="simulated scans (default: among temporary files)")
    _add_settings_argument(parser)


def _add_settings_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--passes", type=float, metavar="N", help="passes over the views, instead of the default"
    )


def _add_comparison_arguments(parser: argparse.ArgumentParser) -> None:
    """Options that all benchmarks that compare methods share."""
    words = "default: pins teeth; NAME-control is a scene without its metal"
    parser.add_argument("--scenes", nargs="+", default=["pins", "teeth"], help=words)
    parser.add_argument("--sizes", nargs="+", type=int, default=[64], help="voxels per edge (default: 64)")
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="METHOD",
        default=_METHODS,
        help=f"among {' '.join(_METHODS)} (the default), sirt-200, mono-water, mbir mbir-mar mbir-metal (mbirtorch)",
    )
    parser.add_argument(
        "--budgets",
        nargs="+",
        type=float,
        default=[],
        metavar="SECONDS",
        help="for methods that improve with time (default: until they stop by themselves)",
    )
    parser.add_argument(
        "--no-curves", action="store_true", help="leave out the runs that are watched as they go"
    )
    parser.add_argument("--cache", metavar="FOLDER", help="simulated scans (default: among temporary files)")


def run(arguments: argparse.Namespace) -> int:
    """Run the benchmark that was named and print its table."""
    if arguments.record:
        Path(arguments.record).mkdir(parents=True, exist_ok=True)
    arguments.device = _device(arguments.device)
    commands: dict[str, Callable[[argparse.Namespace], int]] = {
        "kernels": _kernels,
        "recon": _recon,
        "accuracy": _accuracy,
        "ablation": _ablation,
        "hard": _hard,
        "spectrum": partial(bench_physics.spectrum, write=_write, say=_say),
        "materials": partial(bench_physics.materials, write=_write, say=_say),
        "plan": partial(bench_plan.plan, write=_write, write_text=_write_text, say=_say),
        "scale": partial(bench_scale.scale, write=_write, write_text=_write_text, say=_say),
    }
    return commands[arguments.what](arguments)


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

    record = run_recon_bench(
        _recon_bench(arguments),
        cache=_cache(arguments),
        progress=_say,
        update=lambda so_far: _write(arguments, "recon.json", so_far, quiet=True),
    )
    print(as_text(record))
    _write(arguments, "recon.json", record)
    if arguments.record:
        for path in write_figures(Path(arguments.record), record):
            print(f"wrote {path}")
    return _status(record)


def _status(record: dict[str, Any]) -> int:
    """0, or 1 if a run failed. A method that cannot run on this machine is not a failure."""
    return 0 if all(run["seconds"] is not None or "skipped" in run["about"] for run in record["runs"]) else 1


def _say(words: str) -> None:
    print(words, file=sys.stderr, flush=True)


def _cache(arguments: argparse.Namespace) -> Path | None:
    if not arguments.cache:
        return None
    cache = Path(arguments.cache)
    cache.mkdir(parents=True, exist_ok=True)
    return cache


def _settings(arguments: argparse.Namespace) -> dict[str, Any]:
    return {} if arguments.passes is None else {"passes": arguments.passes}


def _accuracy(arguments: argparse.Namespace) -> int:
    from tomo_polysplat.bench import accuracy_report as report
    from tomo_polysplat.bench.accuracy import CONDITION, AccuracyBench, run_accuracy_bench

    names = ("scenes", "sizes", "methods", "views", "kvp", "photons", "seeds", "budgets", "device")
    chosen = {name: getattr(arguments, name) for name in names}
    bench = AccuracyBench(**chosen, curves=not arguments.no_curves, settings=_settings(arguments))
    pictures: dict[tuple[Any, ...], bytes] = {}

    def update(record: dict[str, Any], where: dict[str, Any], scan: Any, volumes: Any) -> None:
        if arguments.record is None:
            return
        if where["seed"] == 0:
            key = tuple(where[name] for name in CONDITION)
            pictures[key] = report.slices_png(scan, scan.truth_energy_kev, volumes)
        _write(arguments, "accuracy.json", record, quiet=True)
        report.write_page(Path(arguments.record) / "accuracy.html", record, pictures)

    record = run_accuracy_bench(bench, cache=_cache(arguments), progress=_say, update=update)
    print(report.as_text(record))
    _write(arguments, "accuracy.json", record)
    _write_text(arguments, "accuracy.md", report.as_markdown(record))
    return _status(record)


def _ablation(arguments: argparse.Namespace) -> int:
    from tomo_polysplat.bench.ablation import AblationBench, as_markdown, as_text, run_ablation

    names = ("scenes", "size", "views", "photons", "kvp", "seeds", "device")
    chosen = {name: getattr(arguments, name) for name in names}
    if arguments.groups:
        chosen["groups"] = arguments.groups
    bench = AblationBench(**chosen, settings=_settings(arguments))
    record = run_ablation(
        bench,
        cache=_cache(arguments),
        progress=_say,
        update=lambda so_far: _write(arguments, "ablation.json", so_far, quiet=True),
    )
    print(as_text(record))
    _write(arguments, "ablation.json", record)
    _write_text(arguments, "ablation.md", as_markdown(record))
    return _status(record)


def _hard(arguments: argparse.Namespace) -> int:
    from tomo_polysplat.bench.hard import chosen_cases, run_hard_bench
    from tomo_polysplat.bench.hard_report import as_markdown, as_text

    record = run_hard_bench(
        arguments.device,
        chosen_cases(arguments.only),
        progress=_say,
        update=lambda so_far: _write(arguments, "hard.json", so_far, quiet=True),
    )
    print(as_text(record))
    _write(arguments, "hard.json", record)
    _write_text(arguments, "hard.md", as_markdown(record))
    return 0 if all(case["passed"] for case in record["cases"]) else 1


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


def _write_text(arguments: argparse.Namespace, name: str, text: str) -> None:
    if arguments.record is None:
        return
    path = Path(arguments.record) / name
    write_text(path, text, overwrite=True)
    print(f"wrote {path}")

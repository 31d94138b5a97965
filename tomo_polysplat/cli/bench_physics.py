"""``tomo-polysplat bench spectrum`` and ``materials``: what the assumed physics is worth."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from tomo_polysplat.cli.options import add_solver_options
from tomo_polysplat.files import write_text

__all__ = ["add_parsers", "materials", "spectrum"]


def add_parsers(what: Any) -> tuple[argparse.ArgumentParser, argparse.ArgumentParser]:
    """The parsers of the two commands."""
    spectrum = what.add_parser("spectrum", help="what wrong physics costs, without and with calibration")
    _spectrum_arguments(spectrum)
    materials = what.add_parser("materials", help="which materials the three curves stand in for")
    _materials_arguments(materials)
    return spectrum, materials


def _spectrum_arguments(parser: argparse.ArgumentParser) -> None:
    add_solver_options(parser)
    scenes = ["pins", "teeth", "lung-control"]
    words = "default: pins teeth lung-control, which has no metal"
    parser.add_argument("--scenes", nargs="+", default=scenes, help=words)
    parser.add_argument("--cases", nargs="+", metavar="CASE", help="such as 'kVp -10 %%' (default: all)")
    parser.add_argument("--size", type=int, default=48, help="voxels per edge (default: 48)")
    parser.add_argument("--views", type=int, default=120, help="projection images (default: 120)")
    parser.add_argument("--quality", default="fast", help="fast (default), balanced or best")


def _materials_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", default="auto", help="auto (default), cpu, cuda or cuda:N")
    parser.add_argument("--kvp", type=float, default=90.0, help="tube voltage (default: 90)")
    parser.add_argument("--aluminium-cm", type=float, default=0.1, help="its filter in cm (default: 0.1)")
    parser.add_argument("--largest", type=float, default=5.0, help="largest P of the rays (default: 5)")
    parser.add_argument("--size", type=int, default=40, help="voxels of the rods; 0: none (default: 40)")
    parser.add_argument("--rods", nargs="+", metavar="MATERIAL", help="these alone (default: all)")


def spectrum(arguments: argparse.Namespace, write: Callable[..., None], say: Callable[[str], None]) -> int:
    """``bench spectrum``; ``write`` saves a record, ``say`` prints what comes next."""
    from tomo_polysplat.bench.spectrum import SpectrumBench, as_markdown, run_spectrum_bench, write_figure

    names = ("scenes", "size", "views", "quality", "device", "seed")
    bench = SpectrumBench(**_chosen(arguments, names, "cases"))
    record = _recorded(arguments, "spectrum.json", write, partial(run_spectrum_bench, bench, progress=say))
    return _tell(arguments, "spectrum", record, as_markdown(record), write_figure)


def materials(arguments: argparse.Namespace, write: Callable[..., None], say: Callable[[str], None]) -> int:
    """``bench materials``; ``write`` saves a record, ``say`` prints what comes next."""
    from tomo_polysplat.bench.materials import MaterialsBench, as_markdown, run_materials_bench, write_figure

    names = ("kvp", "aluminium_cm", "largest", "size", "device")
    bench = MaterialsBench(**_chosen(arguments, names, "rods"))
    record = _recorded(arguments, "materials.json", write, partial(run_materials_bench, bench, progress=say))
    return _tell(arguments, "materials", record, as_markdown(record), write_figure)


def _chosen(arguments: argparse.Namespace, names: tuple[str, ...], some: str) -> dict[str, Any]:
    """Options by name, and those of which none means all."""
    chosen = {name: getattr(arguments, name) for name in names}
    if getattr(arguments, some):
        chosen[some] = getattr(arguments, some)
    return chosen


def _recorded(
    arguments: argparse.Namespace, file: str, write: Callable[..., None], run: Callable[..., dict[str, Any]]
) -> dict[str, Any]:
    """The record of a benchmark, saved as it grows and at its end."""
    record = run(update=lambda so_far: write(arguments, file, so_far, quiet=True))
    write(arguments, file, record)
    return record


def _tell(
    arguments: argparse.Namespace, name: str, record: dict[str, Any], table: str, figure: Callable[..., None]
) -> int:
    """Print a table, and save it with its figure."""
    print(table)
    if arguments.record:
        folder = Path(arguments.record)
        write_text(folder / f"{name}.md", table, overwrite=True)
        figure(folder / f"{name}.png", record)
        print(f"wrote {folder / name}.md and .png")
    return 0

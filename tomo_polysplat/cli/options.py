"""Options that several subcommands share."""

from __future__ import annotations

import argparse
import re
from collections.abc import Container, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tomo_polysplat.checks import fail

if TYPE_CHECKING:
    from tomo_polysplat.physics.spectrum import Spectrum

__all__ = [
    *("INTERRUPTED", "add_scan_options", "add_solver_options", "add_spectrum_options"),
    *("filter_map_from", "in_options", "scan_from", "spectrum_from", "tube_of_scanner"),
]


# Options that stand for names of `scanner` in `load_scan`, where they differ.
_OPTIONS = {
    "source_object": "sod",
    "source_detector": "sdd",
    "flats": "flat",
    "darks": "dark",
    "arc": "angles",
    "degrees": "angles",
}
_SAME = ("pixel", "offset", "white", "kvp", "filter", "detector", "unit", "input")
_NAMED = re.compile(rf"\b({'|'.join((*_OPTIONS, *_SAME))})=(?![\w'\"{{(])")
# Exit status after Ctrl-C, as shells use it.
INTERRUPTED = 130


def in_options(text: str, known: Container[str]) -> str:
    """A hint of Python's, such as ``give source_object=``, as one types it: ``give --sod``, if that is known."""

    def typed(name: re.Match[str]) -> str:
        option = f"--{_OPTIONS.get(name[1], name[1])}"
        return option if option in known else name[0]

    return _NAMED.sub(typed, text)


def add_spectrum_options(parser: argparse.ArgumentParser) -> None:
    """The x-ray spectrum: a tube with filters and a detector, or a table."""
    group = parser.add_argument_group("spectrum (used instead of the file's)")
    group.add_argument("--kvp", type=float, metavar="KV", help="tube voltage in kV")
    group.add_argument("--anode", help="anode: W, Mo, Rh, Ag, Cu or Au (default: W)")
    group.add_argument(
        "--filter",
        action="append",
        default=[],
        metavar="TEXT",
        help="what the beam passes before the object, such as 'Al 1mm', or none; may be repeated (Al:0.1 is in cm)",
    )
    group.add_argument(
        "--detector",
        metavar="NAME:THICKNESS",
        help="such as csi:0.6mm, gos:0.2mm, luag:0.1mm, silicon:0.3mm, cdte:1mm, or counting (default)",
    )
    group.add_argument(
        "--spectrum", metavar="FILE", help="detected spectrum as text: energy in keV and weight on each line"
    )


def spectrum_from(arguments: argparse.Namespace) -> Spectrum | None:
    """The spectrum that the options describe, or None."""
    from tomo_polysplat.physics.detector import Detector
    from tomo_polysplat.physics.filter_text import require_filters
    from tomo_polysplat.physics.spectrum import Spectrum
    from tomo_polysplat.physics.spectrum_file import read_spectrum_table

    tube = {name: value for name in ("anode", "filter", "detector") if (value := getattr(arguments, name))}
    if arguments.spectrum is not None:
        if tube or arguments.kvp is not None:
            raise fail("--spectrum", "none of --kvp, --anode, --filter, --detector beside it", "both")
        energies, weights = read_spectrum_table(arguments.spectrum, "--spectrum")
        return Spectrum(energies, weights, label=Path(arguments.spectrum).name)
    if arguments.kvp is None:
        for name in tube:
            raise fail(f"--{name}", "--kvp with it", "no --kvp")
        return None
    filters = require_filters("--filter", " + ".join(arguments.filter)) if arguments.filter else None
    named = arguments.detector
    detector = None if named is None else Detector.named(named, "--detector")
    return Spectrum.from_tube(arguments.kvp, arguments.anode or "W", filters, detector)


def tube_of_scanner(arguments: argparse.Namespace, stated: Mapping[str, Any]) -> dict[str, Any]:
    """Options of the tube as what `scanner` of ``load_scan`` says of it, and no more of a spectrum; else nothing.

    They come over a scanner's text: a voltage goes with its filter, and a detector that nobody names is a flat panel.
    """
    from tomo_polysplat.scan.io import is_of_scanner

    if arguments.spectrum is not None or not is_of_scanner(arguments.scan, stated):
        return {}
    tube = {"kvp": arguments.kvp, "anode": arguments.anode, "filter": " + ".join(arguments.filter)}
    tube["detector"] = arguments.detector
    arguments.kvp, arguments.anode, arguments.filter, arguments.detector = None, None, [], None
    return {key: value for key, value in tube.items() if value not in (None, "")}


def filter_map_from(text: str) -> tuple[str, Any]:
    """Material and thickness at each pixel, of MATERIAL:FILE."""
    from tomo_polysplat.scan.filter_map_file import thickness_of

    material, _, name = text.partition(":")
    if not name:
        raise fail("--filter-map", "MATERIAL:FILE, such as Al:bowtie.npy, or fit", repr(text))
    return material, thickness_of(name, "--filter-map")


def add_scan_options(parser: argparse.ArgumentParser) -> None:
    """The scan and what its file leaves open."""
    parser.add_argument(
        "scan",
        metavar="SCAN",
        help="Data Exchange HDF5 file, .npz scan, or what a scanner left: a folder or a file",
    )
    group = parser.add_argument_group("what the file does not say")
    group.add_argument(
        "--unit",
        help="of lengths whose unit no file tells: cm, mm, um, m or pixel (default: mm of a scanner, else cm)",
    )
    group.add_argument(
        "--centre",
        "--center",
        type=float,
        metavar="COLUMN",
        help="parallel beam: rotation axis in columns from the detector's edge (default: estimated)",
    )
    group.add_argument(
        "--pixel-size",
        type=float,
        metavar="SIZE",
        help="parallel beam: pixel in the plane of the object, in --unit",
    )
    group.add_argument(
        "--input",
        choices=["counts", "transmission", "attenuation"],
        help="what the numbers are (default: as the file tells, or by its open-beam images)",
    )
    group.add_argument(
        "--water-correction",
        nargs="+",
        type=float,
        metavar="C",
        help="polynomial that the scanner put -log(I/I0) through, as 0 C1 C2 ... in ascending powers",
    )
    group.add_argument(
        "--saturation", type=float, metavar="COUNTS", help="counts at which the detector saturates"
    )


def scan_from(arguments: argparse.Namespace, spectrum: Spectrum | None = None, **more: Any) -> Any:
    """The scan that the options name; `more` are arguments of ``load_scan`` that only some subcommands have."""
    from tomo_polysplat.scan.io import load_scan

    return load_scan(
        arguments.scan,
        spectrum=spectrum,
        unit=arguments.unit,
        centre=arguments.centre,
        pixel_size=arguments.pixel_size,
        input=arguments.input,
        saturation=arguments.saturation,
        water_correction=arguments.water_correction,
        **more,
    )


def add_solver_options(parser: argparse._ActionsContainer) -> None:
    """Device and seed."""
    parser.add_argument("--device", default="auto", help="auto (default), cpu, cuda or cuda:N")
    parser.add_argument("--seed", type=int, default=0, help="seed of everything random (default: 0)")

"""``tomo-polysplat recon``: from a scan to a volume."""

from __future__ import annotations

import argparse
import json
import logging
import os
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import tomo_polysplat
from tomo_polysplat.checks import fail, visible
from tomo_polysplat.cli.options import (
    INTERRUPTED,
    add_scan_options,
    add_solver_options,
    add_spectrum_options,
    filter_map_from,
    scan_from,
    spectrum_from,
    tube_of_scanner,
)
from tomo_polysplat.cli.recon_outputs import require_outputs, require_room_of, write_outputs
from tomo_polysplat.fit.stopping import StopReason
from tomo_polysplat.interrupts import postponed_interrupts
from tomo_polysplat.progress import progress_reports
from tomo_polysplat.quiet_imports import leaving_no_trace
from tomo_polysplat.settings import make_settings

if TYPE_CHECKING:
    from tomo_polysplat.physics.spectrum import Spectrum
    from tomo_polysplat.result.result import Result
    from tomo_polysplat.scan.scan import Scan

NAME = "recon"
HELP = "reconstruct a scan into a volume of attenuation in 1/length"
EXAMPLES = (
    "tomo-polysplat recon scan.h5 -o volume.tif",
    "tomo-polysplat recon scan.h5 -o result.h5 --report page.html --kvp 90 --filter 'Al 1mm' --detector csi:0.6mm",
)


# Long: a line or two for every option, in the order of the help.
def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    add_scan_options(parser)
    parser.add_argument(
        "-o",
        "--output",
        required=True,
        metavar="FILE",
        help=".h5 with everything, or the volume as .tif, .ome.tif, .mha, .nrrd, .nii.gz, .vti, .npy, "
        ".ome.zarr, .dicom (a series), or a folder of TIFF slices (NAME/)",
    )
    parser.add_argument(
        "--hu", action="store_true", help="Hounsfield units instead of attenuation (not in .h5)"
    )
    parser.add_argument(
        "--bits",
        type=int,
        choices=[16, 32],
        default=32,
        help="16 for whole numbers with their slope and offset in the file (default: 32)",
    )
    parser.add_argument(
        "--unseen-nan",
        action="store_true",
        help="NaN for voxels that no ray sees (not in .h5, not in 16 bits)",
    )
    parser.add_argument("--overwrite", action="store_true", help="replace files that exist")
    parser.add_argument("--report", metavar="FILE", help="write a page about the reconstruction (.html)")
    parser.add_argument(
        "--halves",
        action="store_true",
        help="tell the resolution in the report, by fits of two halves of the views: as long again as the run",
    )
    parser.add_argument(
        "--faint",
        action="store_true",
        help="tell in the report how much of a faint contrast is kept, by a fit with faint balls: as long again",
    )
    parser.add_argument("--tiff", metavar="FOLDER", help="write the slices as TIFF")
    parser.add_argument("--json", metavar="FILE", help="write the plan, the counts and the errors as JSON")
    add_spectrum_options(parser)
    group = parser.add_argument_group("reconstruction")
    group.add_argument(
        "--quality", choices=["fast", "balanced", "best"], default="balanced", help="default: balanced"
    )
    group.add_argument("--time-budget", type=float, metavar="SECONDS", help="stop after this long")
    group.add_argument(
        "--mono", action="store_true", help="ignore the spectrum: one energy, as most methods assume"
    )
    group.add_argument(
        "--energy",
        type=float,
        metavar="KEV",
        help="energy of the volume (default: the spectrum's effective energy)",
    )
    group.add_argument(
        "--materials",
        nargs=3,
        metavar=("SOFT", "MIDDLE", "DENSE"),
        help="base materials (default: water aluminium iron)",
    )
    calibrated = group.add_mutually_exclusive_group()
    calibrated.add_argument(
        "--calibrate",
        nargs="*",
        metavar="WHAT",
        help="fit scatter, kvp or filter first; alone: scatter, and kvp with --soft-density",
    )
    calibrated.add_argument(
        "--no-calibrate", action="store_true", help="do not look for scatter in the rays either"
    )
    moved = group.add_mutually_exclusive_group()
    moved.add_argument(
        "--align",
        nargs="*",
        metavar="MOVE",
        help="first move the geometry to where the rays have it: u, v, roll, tilt, slant, distance, skew, views;"
        " alone: what of these the rays tell (default: axis, roll, views)",
    )
    moved.add_argument("--no-align", action="store_true", help="use the geometry as told")
    group.add_argument(
        "--no-mend",
        action="store_true",
        help="leave the axis where the file has it, whatever the rays show",
    )
    group.add_argument(
        "--filter-map",
        metavar="MATERIAL:FILE",
        help="a filter that is not everywhere as thick, such as a bowtie: its thickness at each pixel (rows, columns) "
        "in --unit, as .npy, .tif or text; one row stands for all. 'fit' finds a bowtie of aluminium",
    )
    group.add_argument(
        "--soft-density", type=float, metavar="G/CM3", help="known density of what most of the object is"
    )
    group.add_argument(
        "--set", action="append", default=[], metavar="NAME=VALUE", help="change one setting; may be repeated"
    )
    add_solver_options(group)
    group.add_argument(
        "--devices",
        metavar="GPUS",
        help="share the fit out over these, such as 0,1, or all (torchrun: over its processes)",
    )
    group.add_argument(
        "--memory",
        metavar="SIZE",
        help='what the run may hold on the device, such as "12 GB" (default: all that is free)',
    )
    group.add_argument(
        "--checkpoint",
        metavar="FILE",
        help="keep the fit there (.npz) while it runs, to go on from with --resume",
    )
    group.add_argument(
        "--resume", action="store_true", help="go on from --checkpoint where that exists, else begin anew"
    )


def run(arguments: argparse.Namespace) -> int:
    """Reconstruct, and write what was asked for; of torchrun's processes the first one does, and the others help."""
    with leaving_no_trace():  # torch is loaded here
        from tomo_polysplat.rank_processes import TORCHRUN, started_by_torchrun

    if not started_by_torchrun():
        return _reconstruct(arguments)
    if arguments.devices is not None:
        raise fail("--devices", "none with torchrun, whose processes have a GPU each", arguments.devices)
    arguments.devices = TORCHRUN
    return _reconstruct(arguments) if os.environ["RANK"] == "0" else _follow(arguments.device)


def _reconstruct(arguments: argparse.Namespace) -> int:
    require_outputs(arguments)
    settings = _settings(arguments)
    # Refused before the scan is read.
    make_settings(arguments.quality, settings)
    tube = tube_of_scanner(arguments, {})
    scan = scan_from(arguments, spectrum_from(arguments), scanner=tube or None)
    spectrum = _spectrum_of(scan, arguments)
    scan, to_find = _filtered(scan, arguments.filter_map)
    require_room_of(arguments, scan)
    print(visible(scan))
    # What a run will take is said without -v as well.
    logging.getLogger("tomo_polysplat.plan.expected").setLevel(logging.INFO)
    result = _fitted(replace(scan, spectrum=spectrum), to_find, settings, arguments)
    with postponed_interrupts("writing") as interruption:
        if arguments.energy is not None:
            result = replace(result, energy_kev=arguments.energy)
        result.provenance = {"scan": scan.name} | result.provenance
        print(visible(result))
        write_outputs(result, scan, arguments)
    stop = result.plan.get("stop")
    interrupted = stop is not None and stop.value == StopReason.INTERRUPTED
    return INTERRUPTED if interruption.asked or interrupted else 0


def _fitted(
    scan: Scan, to_find: str | None, settings: dict[str, Any], arguments: argparse.Namespace
) -> Result:
    from tomo_polysplat.kernels.ahead import compiled_ahead

    with progress_reports(None) as progress, compiled_ahead(arguments.device):
        return tomo_polysplat.reconstruct(
            scan,
            materials=arguments.materials,
            quality=arguments.quality,
            time_budget=arguments.time_budget,
            seed=arguments.seed,
            device=arguments.device,
            devices=arguments.devices,
            calibrate=_calibrated(arguments),
            align=_aligned(arguments),
            soft_density=arguments.soft_density,
            filter_map=to_find,
            mend=not arguments.no_mend,
            progress=progress,
            settings=settings or None,
            checkpoint=arguments.checkpoint,
            resume=arguments.resume,
        )


def _follow(device: str) -> int:
    """Make the steps that the first process tells this one to make."""
    from tomo_polysplat.fit.follow import follow_torchrun

    follow_torchrun(device)
    return 0


def _filtered(scan: Scan, told: str | None) -> tuple[Scan, str | None]:
    """The scan with the filter that is told, and "fit" where one is to be found."""
    from tomo_polysplat.fit.filtered import FIT

    if told is None or told == FIT:
        return scan, told
    return replace(scan, filter_map=filter_map_from(told)), None


def _aligned(arguments: argparse.Namespace) -> str | bool | list[str]:
    """The argument ``align`` of `reconstruct`."""
    if arguments.no_align:
        return False
    return "auto" if arguments.align is None else arguments.align or True


def _calibrated(arguments: argparse.Namespace) -> bool | list[str] | None:
    """What `reconstruct` is to calibrate; None leaves it to the rays."""
    if arguments.calibrate is None:
        return False if arguments.no_calibrate else None
    return arguments.calibrate or True


def _spectrum_of(scan: Scan, arguments: argparse.Namespace) -> Spectrum | None:
    """The spectrum to fit under, with the lengths and the energy that it needs."""
    from tomo_polysplat.physics.spectrum import require_energy_of

    spectrum = None if arguments.mono else scan.spectrum
    if spectrum is not None and scan.unit == "pixel":
        remedy = "a spectrum needs real lengths: pass it with --unit, or --mono to ignore the spectrum"
        raise fail("--pixel-size", "the size of a pixel beside a spectrum", "none", remedy)
    if arguments.energy is not None:
        if spectrum is None:
            raise fail("--energy", "a spectrum, from the file or from --kvp", "none")
        require_energy_of("--energy", arguments.energy, spectrum)
    return spectrum


def _settings(arguments: argparse.Namespace) -> dict[str, Any]:
    """Single settings by name."""
    memory = {} if arguments.memory is None else {"memory": arguments.memory}
    return dict(_setting(text) for text in arguments.set) | memory


def _setting(text: str) -> tuple[str, Any]:
    name, separator, value = text.partition("=")
    if not separator:
        raise fail("--set", "NAME=VALUE", repr(text))
    try:
        return name, json.loads(value)
    except ValueError:
        return name, value

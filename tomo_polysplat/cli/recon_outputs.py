"""What ``tomo-polysplat recon`` writes: checked before the work, and written after it."""

from __future__ import annotations

import argparse
import logging
import math
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, visible
from tomo_polysplat.files import require_replaceable, require_room_for, require_writable
from tomo_polysplat.result.files import write_json

if TYPE_CHECKING:
    from tomo_polysplat.result.result import Result
    from tomo_polysplat.scan.scan import Scan

__all__ = ["require_outputs", "require_room_of", "write_outputs"]

logger = logging.getLogger(__name__)


def require_outputs(arguments: argparse.Namespace) -> None:
    """Refuse outputs that could not be written, before the work begins."""
    from tomo_polysplat.result.formats import format_of
    from tomo_polysplat.result.tiff import require_slices_folder

    kind = format_of(arguments.output, "--output")
    if not (kind.everything and arguments.tiff is not None):
        kind.require(hu=arguments.hu, bits=arguments.bits, argument="--output")
    for name in ("halves", "faint"):
        if getattr(arguments, name) and arguments.report is None:
            raise fail(f"--{name}", "--report with it, where it is told", "none")
    if arguments.unseen_nan and (kind.everything or kind.hounsfield or arguments.bits == 16):
        remedy = "choose another ending of --output, and 32 bits"
        raise fail("--unseen-nan", "a file of the volume alone, in floating point", arguments.output, remedy)
    if arguments.resume and arguments.checkpoint is None:
        raise fail("--resume", "--checkpoint with it", "none")
    written, folders = {}, {}
    for name in ("output", "report", "json", "tiff"):
        if (path := getattr(arguments, name)) is None:
            continue
        if name == "tiff" or (name == "output" and kind.folder):
            require = require_slices_folder if name == "tiff" else kind.require_folder
            folders[f"--{name}"] = require(
                path, overwrite=arguments.overwrite, remedy="pass --overwrite", argument=f"--{name}"
            )
        else:
            file = require_replaceable(path, arguments.overwrite, "pass --overwrite", f"--{name}")
            require_writable(file.parent, f"--{name}")
            written[f"--{name}"] = file
    if arguments.checkpoint is not None:
        remedy = "pass --resume to go on from it, or remove it"
        written["--checkpoint"] = require_replaceable(
            arguments.checkpoint, arguments.resume, remedy, "--checkpoint"
        )
    _require_apart(arguments, written, folders)


def _require_apart(arguments: argparse.Namespace, written: dict[str, Path], folders: dict[str, Path]) -> None:
    """Refuse to write a file twice, over an input, or into a folder that is replaced as a whole."""
    read = {name: Path(path) for name in ("scan", "spectrum") if (path := getattr(arguments, name))}
    seen: dict[Path, str] = {}
    for name, path in (read | written | folders).items():
        real = Path(os.path.realpath(path))
        twin = seen.get(real) or next((name for old, name in seen.items() if _same_file(old, real)), None)
        if twin is not None:
            wanted = "a file of its own for the scan, the spectrum and everything written"
            raise fail(name, wanted, f"one file twice: {path} is {twin} too")
        seen[real] = name
    for name, folder in folders.items():
        inside = [other for path, other in seen.items() if Path(os.path.realpath(folder)) in path.parents]
        if inside:
            raise fail(name, "a folder of its own, replaced as a whole", f"{folder}, which holds {inside[0]}")


def _same_file(one: Path, other: Path) -> bool:
    """Whether two names, perhaps with other letters or case, mean one file."""
    try:
        return one.samefile(other)
    except OSError:
        return False


def require_room_of(arguments: argparse.Namespace, scan: Scan) -> None:
    """Refuse, before the work begins, a volume that the disk has no room for, or that the file cannot hold."""
    from tomo_polysplat.result.formats import format_of

    voxels = math.prod(scan.volume_shape)
    kind = format_of(arguments.output, "--output")
    if not kind.everything:
        kind.require(hu=arguments.hu, bits=arguments.bits, voxels=voxels, argument="--output")
    if arguments.hu or kind.hounsfield:
        _require_hounsfield(arguments, scan, "--hu" if arguments.hu else "--output")
    # At most three curves.
    needed = {Path(arguments.output).parent: kind.bytes_needed(voxels, 3, arguments.bits)}
    if arguments.tiff is not None:
        folder = Path(arguments.tiff)
        needed[folder] = needed.get(folder, 0) + voxels * arguments.bits // 8
    require_room_for(needed)


def _require_hounsfield(arguments: argparse.Namespace, scan: Scan, option: str) -> None:
    """Refuse Hounsfield units without a spectrum or a real length: they compare with water at an energy."""
    if scan.unit == "pixel" or arguments.mono or scan.spectrum is None:
        spectrum = "leave --mono out" if arguments.mono else "pass --kvp or --spectrum and the pixel's size"
        remedy = f"{spectrum}, or leave Hounsfield units out"
        raise fail(
            option, "a spectrum and real lengths for Hounsfield units", "a volume without an energy", remedy
        )


def write_outputs(result: Result, scan: Scan, arguments: argparse.Namespace) -> None:
    """Write all outputs. If one of them fails, the others are still written."""
    failures: list[OSError] = []
    _explain(result, scan, arguments)
    _attempt(arguments.output, failures, lambda: _save(result, arguments))
    if failures:
        _rescue(result, arguments)
    if arguments.tiff is not None:
        about = {"overwrite": arguments.overwrite, "hu": arguments.hu, "bits": arguments.bits}
        _attempt(arguments.tiff, failures, lambda: result.save_tiff(arguments.tiff, **about))
    _write_about(result, scan, arguments, failures)
    if failures:
        raise failures[0]


def _explain(result: Result, scan: Scan, arguments: argparse.Namespace) -> None:
    """Let the file that holds everything hold the residuals, too, which `view` and a report then show."""
    from tomo_polysplat.result.formats import format_of

    if not format_of(arguments.output).everything or not result.gaussians:
        return
    # Who has little time has it for the report alone.
    if arguments.time_budget is not None and arguments.report is None:
        return
    try:
        result.explain(scan, device=arguments.device)
    except (ValueError, RuntimeError, MemoryError) as error:
        logger.warning("How well the rays are explained is not kept: %s", error)


def _write_about(result: Result, scan: Scan, arguments: argparse.Namespace, failures: list[OSError]) -> None:
    """The report, the errors and the JSON file."""
    from tomo_polysplat.report.table import as_text

    overwrite, errors = arguments.overwrite, _errors(result, scan)
    if arguments.report is not None:
        comparable = errors is not None and _same_energy(result, scan)
        known = {"truth": scan.truth, "metal_mask": scan.metal_mask} if comparable else {}
        _attempt(
            arguments.report,
            failures,
            lambda: _report(result, scan, arguments, known),
        )
    if errors is not None:
        print(as_text([errors], result.unit))
    if arguments.json is not None:
        names = ("unit", "energy_kev", "seconds", "plan", "counts", "provenance")
        about = {name: getattr(result, name) for name in names}
        about |= {"scan": arguments.scan, "errors": errors}
        _attempt(arguments.json, failures, lambda: write_json(arguments.json, about, overwrite=overwrite))


def _report(
    result: Result, scan: Scan, arguments: argparse.Namespace, known: dict[str, np.ndarray | None]
) -> None:
    """The page, with what more fits tell where that was asked for."""
    from tomo_polysplat.quality.halves import resolution
    from tomo_polysplat.quality.inserts import contrast

    device = arguments.device
    result.report(
        arguments.report,
        scan=scan,
        truth=known.get("truth"),
        metal_mask=known.get("metal_mask"),
        resolution=resolution(result, scan, device=device) if arguments.halves else None,
        contrast=contrast(result, scan, device=device) if arguments.faint else None,
        overwrite=arguments.overwrite,
    )


def _save(result: Result, arguments: argparse.Namespace) -> None:
    from tomo_polysplat.result.formats import format_of

    everything = format_of(arguments.output, "--output").everything
    options = {"hu": arguments.hu, "bits": arguments.bits, "unseen_nan": arguments.unseen_nan}
    options = {} if everything else options
    result.save(arguments.output, overwrite=arguments.overwrite, **options)


def _attempt(path: str, failures: list[OSError], write: Callable[[], None]) -> None:
    """Write one file; add its error, if any, to the failures and go on."""
    try:
        write()
    except OSError as error:
        logger.error("%s was not written: %s", path, error)
        failures.append(error)
    else:
        print(f"wrote {visible(path)}")


def _rescue(result: Result, arguments: argparse.Namespace) -> None:
    """Save the result, which may have taken hours, to a new temporary folder with a random name."""
    folder = Path(tempfile.mkdtemp(prefix="tomo-polysplat-"))
    path = folder / "rescued.h5"
    try:
        result.save(path)
    except OSError as error:
        logger.error("Nor could the result be kept in %s: %s", folder, error)
        folder.rmdir()
    else:
        print(f"the whole result is in {visible(path)}")


def _errors(result: Result, scan: Scan) -> dict[str, Any] | None:
    """Errors at the energy of the truth, if the scan has a truth that the volume can be compared with."""
    if scan.truth is None:
        return None
    from tomo_polysplat.result.metrics import compare

    energy = _truth_energy(scan)
    volume = result.volume if result.is_monochromatic or energy is None else result.attenuation(energy)
    name = "mono" if result.is_monochromatic else "polysplat"
    try:
        found = compare(volume, scan.truth, scan.metal_mask)
    except ValueError as error:
        logger.warning("Not compared with the truth: %s", error)
        return None
    return {"name": name, "seconds": result.seconds, **found}


def _truth_energy(scan: Scan) -> float | None:
    if scan.truth_energy_kev is not None or scan.spectrum is None:
        return scan.truth_energy_kev
    return scan.spectrum.effective_energy


def _same_energy(result: Result, scan: Scan) -> bool:
    energy = _truth_energy(scan)
    return energy is None or result.energy_kev is None or abs(energy - result.energy_kev) < 0.05

"""The stages of a reconstruction in order; the only module that knows them all."""

from __future__ import annotations

import logging
import math
import os
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch

from tomo_polysplat.checks import fail
from tomo_polysplat.fit.filtered import FIT, can_be_found, filter_to_find, filtered
from tomo_polysplat.fit.memory import require_machine
from tomo_polysplat.fit.optimise import FitOutcome, FitState
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.soft_matter import describe_soft
from tomo_polysplat.fit.stopping import StopReason
from tomo_polysplat.fit.surroundings import cut_out
from tomo_polysplat.free_memory import limit_memory, memory_limits
from tomo_polysplat.interrupts import postponed_interrupts
from tomo_polysplat.kernels.compile_time import compiled_seconds, working_time
from tomo_polysplat.kernels.device import one_torch_thread, pick_device, usual_modes
from tomo_polysplat.nuisances.detector_blur import BlurOfDetector
from tomo_polysplat.parallel import kept_threads
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.spectrum import Spectrum, require_spectrum
from tomo_polysplat.physics.water_correction import describe_polynomial
from tomo_polysplat.plan.alignment import moves_of
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.plan.calibration import Calibration
from tomo_polysplat.plan.checkpoint import Checkpoint
from tomo_polysplat.plan.model import all_curves
from tomo_polysplat.plan.never_worse import densities_of_start
from tomo_polysplat.plan.open_beam import take_out_level
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.plan.preparation import PreparedFit, RunOptions
from tomo_polysplat.plan.solver import Solver
from tomo_polysplat.plan.unit_check import tell_impossible
from tomo_polysplat.progress import progress_reports
from tomo_polysplat.rank_processes import TORCHRUN, devices_of, rank_of_torchrun, share_out, sharing_ends
from tomo_polysplat.ranks import Ranks, current_ranks
from tomo_polysplat.result.provenance import provenance
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.coverage import unseen_share
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, from_astra, is_planar_geometry, to_astra
from tomo_polysplat.scan.measurement import Measurement
from tomo_polysplat.scan.mending import mend_scan
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.scan.usable import usable_rays
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.initial import FEW_VIEWS
from tomo_polysplat.transfer import to_host
from tomo_polysplat.units import warn_of_unit

__all__ = ["reconstruct"]

logger = logging.getLogger(__name__)

# So many views tell which pixels measure.
_VIEWS_OF_PIXELS = 16


# One parameter for each option that a caller names.
@usual_modes()
@memory_limits()
@sharing_ends()
@kept_threads()
def reconstruct(
    projections: Any,
    proj_geom: Mapping[str, Any] | None = None,
    vol_geom: Mapping[str, Any] | None = None,
    *,
    spectrum: Spectrum | None = None,
    materials: Materials | Sequence[Any] | None = None,
    unit: str | None = None,
    quality: str = "balanced",
    time_budget: float | None = None,
    seed: int = 0,
    device: str = "auto",
    devices: str | Sequence[int | str] | None = None,
    valid: Any = None,
    water_correction: Sequence[float] | None = None,
    filter_map: Sequence[Any] | str | None = None,
    calibrate: bool | str | Sequence[str] | None = None,
    soft_density: float | None = None,
    align: bool | str | Sequence[str] | None = "auto",
    mend: bool = True,
    callbacks: Sequence[Callable[[FitState], Any]] = (),
    progress: bool | Callable[[float, str], Any] | None = None,
    settings: Settings | Mapping[str, Any] | None = None,
    checkpoint: str | os.PathLike | None = None,
    resume: bool = False,
) -> Result:
    """Reconstruct a scan as a cloud of Gaussians, through a polychromatic model of its rays.

    Parameters
    ----------
    projections : Scan, or array, shape (rows, views, columns), or (views, columns) for 2D geometries
        A :class:`~tomo_polysplat.Scan` brings its geometries, unit, spectrum, usable rays and water correction; what is
        named beside it takes the place of its own. Of an array:
        -log(I/I0) in ASTRA's order; in which order the views come changes nothing. Infinite ones, of rays without
        light, are opaque where dark rays surround them. What else is not finite, what no logarithm takes, pixels
        that never change, and the masked ones of a masked array are not used, and counted. The log says when that
        is more than a fifth of them. Counts, transmissions and logarithms of the other sign or of a wrong scale are
        refused where they show as such.
    proj_geom, vol_geom : dict
        ASTRA geometries, lengths in ``unit``; vol_geom's window must be in the same unit.
    spectrum : Spectrum, optional
        Detected spectrum. None, or a single energy, fits a monochromatic model.
    materials : Materials or three names, optional
        The soft, middle and dense material whose curves the model mixes; water, aluminium, iron by default. One
        energy has no use for them, which the log says.
    unit : {"cm", "mm", "um", "m", "pixel"}
        Unit of length of the geometries; the volume comes in 1/unit. The log warns where none stands beside a spectrum.
        "pixel" goes with no spectrum only.
    quality : {"fast", "balanced", "best"}
        Preset of the settings; none beside a whole ``Settings`` object.
    time_budget : float, optional
        Seconds after which the best result so far is returned: never less than the start volume. Compiling kernels,
        once a machine, does not count; the log says early on how much of the run there is room for.
    seed : int
        Seed of every random choice.
    device : {"auto", "cpu", "cuda", "cuda:N"}
    devices : "all", numbers of GPUs such as ``[0, 1]``, or "torchrun", optional
        Share the fit's steps out over these GPUs, in a process each; the first one does everything else. "torchrun":
        over the processes that torchrun has started, of which only the first one may come here; the others call
        `tomo_polysplat.fit.follow.follow_torchrun`, as the command line does.
    valid : bool array, shape of ``projections``, optional
        False for rays that must not be used.
    water_correction : sequence of float, optional
        Coefficients c_0 = 0, c_1, ... of the polynomial ``sum_k c_k P^k`` that the scanner has put its
        -log(I/I0) through; it is undone first, so that every ray keeps the noise of its counts. With a
        spectrum only.
    filter_map : (material, thickness) or (material, thickness, density), or "fit", optional
        A filter that is not everywhere as thick, such as a bowtie: its thickness at each pixel, an array
        (rows, columns) in ``unit``, or one row for all; g/cm3 where the material has no known density. The open beam
        I0 was measured through it. Each pixel then has the spectrum behind its filter; ``spectrum`` is that in front.
        "fit" finds a bowtie of aluminium by two fits by joined pixels, in place of a map that a `Scan` brings; not
        beside a ``time_budget``. ``result.plan["bowtie"]`` tells its coefficients in cm (docs/spectrum.md).
    calibrate : bool or names among "scatter", "kvp", "filter", optional
        Fit these by a few short fits first, and use what fits the held-out rays better: a scattered signal, and the
        tube's voltage or its filters, which need ``soft_density``. True calibrates scatter, and the voltage where
        the density is given; False nothing; None scatter, where the rays show it after three tenths of the fit, which
        then begins anew (and callbacks see its iterations and share begin again).
        ``result.plan["calibration"]`` and ``["scatter"]`` tell what came of it; what a time budget leaves no room for
        is left as it is.
    soft_density : float, optional
        Known density in g/cm3, at most 25, of what most of the object is made of, the first of ``materials``.
    align : "auto", bool, or names among "u", "v", "roll", "tilt", "slant", "distance", "skew", "views"
        Move the scanner's geometry to where the rays have it, before the fit. "auto": the detector along its columns
        where opposite rays say that the axis of rotation is off and two short fits confirm it, its roll and shifts of
        single views where a fit of one pass shows them and a few more confirm them; a scan that is right stays as it
        is, bit for bit. True: the skew of the axis as well, by fits that take a quarter to a half of the run's time.
        Names: these alone, likewise; pixels, degrees, and per cent of the distance. Moves that held-out rays do not
        confirm are not made.
        `Result.geometry` is the geometry found, ``result.plan["alignment"]`` the moves. None or False: the geometry
        is as told. Beside a ``time_budget`` "auto" alone, without the fits.
    mend : bool
        Of a `Scan` with its own geometry, move the detector where the rays show beyond doubt that the axis of rotation
        is off (`tomo_polysplat.scan.mending`). The log and ``result.plan["mended"]`` say so. False leaves the axis, and
        ``align="auto"`` then moves it neither.
    callbacks : sequence of callables
        Each gets a :class:`~tomo_polysplat.fit.optimise.FitState` once a pass over the views; returning True
        ends the fit.
    progress : bool or callable, optional
        A bar on standard error (True, or None on a terminal), or a function of (share, words).
    settings : Settings or mapping, optional
        Changes of single settings by name.
    checkpoint : path, optional
        A file (``.npz``) that keeps the fit, written between passes over the views for at most 5 % of the time.
    resume : bool
        Go on from ``checkpoint`` where it exists, which must be of the same scan and options, and begin anew
        where it does not. On the same device the result is that of a run without interruption. A time budget
        counts the seconds of both.

    Returns
    -------
    Result
        After Ctrl-C, the best state so far.

    Raises
    ------
    ValueError, TypeError
        For input that does not fit together; the message names the argument and the remedy.
    MemoryError
        For a scan, a volume, a spectrum or a cloud of Gaussians that this machine has no room for; the message tells
        bytes needed, bytes free, and the remedy.
    FileExistsError
        For a checkpoint that exists, without ``resume``.
    OSError
        For a checkpoint that cannot be written.
    RankFailed
        If the process of one of several devices dies, or fails; the message names it and tells why.
    KeyboardInterrupt
        After Ctrl-C before the fit has begun, or a second one after it.
    """
    begun = time.perf_counter()
    device, shared = _devices(devices, device)
    share_out(shared)
    run_options = RunOptions.of(quality, settings, time_budget, seed, device, callbacks)
    limit_memory(run_options.settings.memory, run_options.device.type)
    started, compiled = working_time(), compiled_seconds()
    mended: list[str] = []
    if mend and isinstance(projections, Scan) and proj_geom is None:
        projections, mended = mend_scan(projections)
    projections, told_filter, bowtie = filter_to_find(projections, filter_map, time_budget)
    measured = Measurement(
        projections, proj_geom, vol_geom, unit, spectrum, valid, water_correction, told_filter
    ).filled()
    if measured.unit is None and measured.spectrum is not None:
        warn_of_unit("cm")
    unit, spectrum = measured.unit or "cm", require_spectrum("spectrum", measured.spectrum)
    geometry, grid = from_astra(*measured.geometries())
    problem, counts, beam = _problem(measured, geometry, grid, materials, run_options, calibrate)
    run_options = run_options.allowing(problem.noise(run_options.device))
    wanted = Calibration.of(calibrate, soft_density, problem.spectrum)
    flipped = is_planar_geometry(measured.geometries()[0])
    moved = moves_of(align if mend or align != "auto" else None, time_budget)
    bowtie = bowtie and can_be_found(problem, measured.geometries()[0]["type"])
    asked = None if wanted is None else {"names": wanted.names, "soft_density": wanted.soft_density}
    options = (
        run_options.to_dict()
        | {
            "calibration": asked or ("as the rays ask" if calibrate is None else None),
            "align": moved,
        }
        | ({"filter_map": FIT} if bowtie else {})
    )
    saved = _checkpoint(checkpoint, resume, problem, options)
    before = 0.0 if saved is None else saved.seconds
    started, begun = started - before, begun - before
    with one_torch_thread(run_options.device), progress_reports(progress) as report:
        solver = Solver(run_options, saved, started, flipped, report, moved, bowtie)
        problem, prepared, outcome = solver.solve(problem, wanted, ask_scatter=calibrate is None)
        _note_ranks(prepared.plan)
        _note_scan(prepared.plan, problem, grid, measured.water_correction, mended)
        prepared.plan.facts["beam"] = beam
        with postponed_interrupts("the volume") as interruption:
            report(1.0, "volume")
            result = _result(
                outcome,
                prepared,
                problem,
                grid,
                unit=unit,
                spectrum=problem.spectrum or spectrum,
                flipped_2d=flipped,
                counts=counts | outcome.counts(),
                settings=run_options.settings.to_dict() | {"seed": run_options.seed, "quality": quality},
                provenance=provenance(geometry, grid, unit, spectrum, run_options.device),
                geometry=to_astra(problem.told_geometry(), grid)[0],
                **problem.taken.told(problem.order),
            )
    result.plan["stop"] = _stopped(outcome, interruption.asked)
    if time_budget is not None and compiled_seconds() > compiled:
        words = "seconds of compiling kernels, once a machine; a time budget does not count them"
        result.plan["compiling"] = Answer.found(compiled_seconds() - compiled, words)
    result.seconds = time.perf_counter() - begun
    logger.info("Reconstructed in %.1f s: %s; %s", result.seconds, result.plan["stop"].why, result.counts)
    return result


def _devices(devices: Any, device: str) -> tuple[str, list[torch.device] | Ranks | None]:
    """The device of this process, and over what the steps are shared out."""
    if devices == TORCHRUN:
        ranks = rank_of_torchrun(device)
        return str(ranks.device), ranks
    names = devices_of(devices, device)
    if names is None:
        return device, None
    return names[0], [pick_device(name) for name in names]


def _note_ranks(plan: Plan) -> None:
    """Say over how many processes the steps were shared out."""
    ranks = current_ranks()
    if ranks.count > 1:
        plan.note(
            "ranks",
            ranks.count,
            f"each holds a part of the Gaussians, on {ranks.device.type} devices",
        )


def _problem(
    measured: Measurement,
    geometry: Geometry,
    grid: VolumeGrid,
    materials: Any,
    options: RunOptions,
    calibrate: Any,
) -> tuple[Problem, dict[str, int], Answer]:
    """What is to be solved, on this machine, counts of the rays that are used, and what is told of the open beam."""
    proj_geom, _ = measured.geometries()
    spectrum, unit, on = measured.spectrum, measured.unit or "cm", options.device
    energies = 1 if spectrum is None else len(spectrum.energies)
    require_machine(math.prod(np.shape(measured.projections)), math.prod(grid.shape), energies, on)
    # What torch adds up depends on how many threads it has.
    with one_torch_thread(on):
        values, counts, given = usable_rays(
            measured.projections, proj_geom, measured.valid, measured.water_correction, spectrum
        )
        asked = _asks_scatter(calibrate, spectrum, geometry.views)
        wanted = options.settings.beam
        # Before anything else is asked of the rays.
        beam = take_out_level(values, given, geometry, grid, wanted=wanted, scatter_is_asked=asked)
        widest = options.settings.surroundings
        problem = Problem.of(values, geometry, grid, unit, spectrum, materials, widest, on, own=True)
        problem = replace(problem, given=given)
        problem = filtered(problem, measured.filter_map, unit, proj_geom["type"] == "cyl_cone_vec")
    # Made larger where the object is, it may have many times the voxels.
    try:
        require_machine(0, math.prod(problem.grid.shape), energies, on)
    except MemoryError as full:
        if not problem.surroundings:
            raise
        remedy = "settings={'surroundings': 0} leaves that out"
        raise MemoryError(f"{full}. The volume is {problem.surroundings}: {remedy}") from full
    return problem, counts, beam


def _asks_scatter(calibrate: Any, spectrum: Spectrum | None, views: int) -> bool:
    """Whether the rays are asked about scatter in the course of the run."""
    if spectrum is None or spectrum.is_monochromatic:
        return False
    if calibrate is None:
        return views >= FEW_VIEWS
    return "scatter" in calibrate if isinstance(calibrate, Sequence) else bool(calibrate)


def _note_scan(
    plan: Plan,
    problem: Problem,
    grid: VolumeGrid,
    water_correction: Sequence[float] | None,
    mended: list[str],
) -> None:
    """Put into the plan what was known of the scan before the fit, and what was done about it."""
    if water_correction is not None:
        plan.note("water_correction", "undone", describe_polynomial(water_correction))
    plan.note("unseen", *_unseen(problem, grid))
    if mended:
        plan.note("mended", "the axis", "; ".join(mended))
    if problem.filter_map is not None and "bowtie" not in plan.facts:
        plan.note("filter_map", "modelled", problem.filter_map.describe())


def _unseen(problem: Problem, grid: VolumeGrid) -> tuple[float, str]:
    """Share of the volume that no ray sees, and what that means."""
    some = problem.projections[:: -(-len(problem.projections) // _VIEWS_OF_PIXELS)]
    share = unseen_share(problem.told_geometry(), grid, np.isfinite(some).any(axis=0))
    if share == 0:
        return share, "every part of the volume is seen by some ray"
    words = f"no ray sees {100 * share:.2g} % of the volume: not measured, which is not air; Result.coverage tells"
    logger.info("%s", words)
    return share, words


def _stopped(outcome: FitOutcome, interrupted: bool) -> Answer:
    """What ended the run, or the making of its volume."""
    assert outcome.stop is not None
    reason, words = outcome.stop.reason, outcome.stop.words
    if interrupted and reason is not StopReason.INTERRUPTED:
        reason, words = StopReason.INTERRUPTED, f"{words}, then interrupted"
    return Answer.found(reason.value, words)


def _checkpoint(
    path: str | os.PathLike | None, resume: bool, problem: Problem, options: Mapping[str, Any]
) -> Checkpoint | None:
    if path is None:
        if resume:
            raise fail("resume", "a checkpoint to go on from", "none", "pass checkpoint= as well")
        return None
    return Checkpoint(path, problem, options, resume=resume)


def _result(
    outcome: FitOutcome, prepared: PreparedFit, problem: Problem, grid: VolumeGrid, **about: Any
) -> Result:
    """Volumes and Gaussians in the caller's coordinates."""
    plan, scene, gaussians, length = prepared.plan, prepared.scene, outcome.gaussians, problem.length
    if plan.blurred:
        fitted = about["settings"]["learning_rate_blur"] > 0
        blur = float(gaussians.blur)
        plan.note("fitted_blur", blur, BlurOfDetector.describe(blur, fitted=fitted))
    if plan.curves > 1 and len(gaussians):
        number, tunables = float(gaussians.shared_material[0]), about["settings"]
        plan.note("soft_material", number, describe_soft(number, plan.soft_u, tunables["soft_gain"]))
    with torch.no_grad():
        if outcome.start is None:
            own = scene.basis_on_host(gaussians, plan.reference)
        else:
            own = to_host(densities_of_start(outcome.start, plan, problem, scene.reference_curve))
        own = cut_out(own, problem.margin)
        heights = gaussians.weights(scene.reference_curve).sum(dim=0)
        parts = {
            "position": to_host(gaussians.position) * length + problem.centre,
            "scale": to_host(gaussians.scale()) * length,
            "rotation": to_host(torch.nn.functional.normalize(gaussians.rotation, dim=1)),
            "density": to_host(heights) * plan.reference,
            "u": to_host(gaussians.material()),
        }
    levels = (about["settings"][name] for name in ("bone_level", "metal_level"))
    curves = all_curves(problem, own, plan, *levels)
    # Of the start, all matter is taken for soft.
    if problem.polychromatic and outcome.start is None:
        counts = about["counts"]
        lightless = (counts["rays_not_finite"] + counts["rays_opaque"]) / counts["rays"]
        tell_impossible(curves, plan.facts, lightless)
    return Result(
        curves,
        grid,
        energy_kev=None if about["spectrum"] is None else about["spectrum"].effective_energy,
        materials=problem.materials,
        gaussians={} if outcome.start is not None else parts,
        history=outcome.history,
        plan=plan.told(),
        **about,
    )

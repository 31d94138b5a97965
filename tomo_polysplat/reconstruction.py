"""The stages of a reconstruction in order; the only module that knows them all."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch

from tomo_polysplat.checks import fail, require_array, require_number, require_shape
from tomo_polysplat.fit.noise import photons_per_ray
from tomo_polysplat.fit.optimise import FitOutcome, FitState, fit
from tomo_polysplat.fit.plan import Plan, make_plan
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.kernels import select
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.model.seed import seed_gaussians
from tomo_polysplat.physics.materials import Materials
from tomo_polysplat.physics.quadrature import fit_quadrature
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.water import transmitted_energy, water_equivalent
from tomo_polysplat.render.renderer import detector_views, voxel_box
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import (
    Geometry,
    VolumeGrid,
    from_astra,
    is_planar_geometry,
    projections_from_astra,
)
from tomo_polysplat.settings import Settings, make_settings
from tomo_polysplat.start.initial import initial_volume
from tomo_polysplat.units import LENGTH_UNITS, cm_per

__all__ = ["reconstruct"]

logger = logging.getLogger(__name__)

# Beyond this a ray says "opaque", not how opaque: the spectral nodes are fitted up to it at most.
_LARGEST_PROJECTION = 15.0


def reconstruct(
    projections: Any,
    proj_geom: Mapping[str, Any],
    vol_geom: Mapping[str, Any],
    *,
    spectrum: Spectrum | None = None,
    materials: Materials | Sequence[Any] | None = None,
    unit: str = "cm",
    quality: str = "balanced",
    time_budget: float | None = None,
    seed: int = 0,
    device: str = "auto",
    valid: Any = None,
    callbacks: Sequence[Callable[[FitState], Any]] = (),
    progress: bool | Callable[[float, str], Any] | None = None,
    settings: Settings | Mapping[str, Any] | None = None,
) -> Result:
    """Reconstruct a scan as a cloud of Gaussians, through a polychromatic model of its rays.

    Parameters
    ----------
    projections : array, shape (rows, views, columns), or (views, columns) for 2D geometries
        -log(I/I0) in ASTRA's order. Values that are not finite are not used, and counted.
    proj_geom, vol_geom : dict
        ASTRA geometries, lengths in ``unit``; vol_geom's window must be in the same unit.
    spectrum : Spectrum, optional
        Detected spectrum. None, or a single energy, fits a monochromatic model.
    materials : Materials or three names, optional
        The soft, middle and dense material whose curves the model mixes; water, aluminium, iron by default.
    unit : {"cm", "mm", "um", "m", "pixel"}
        Unit of length of the geometries; the volume comes in 1/unit. "pixel" goes with no spectrum only.
    quality : {"fast", "balanced", "best"}
        Preset of the settings.
    time_budget : float, optional
        Seconds after which the best result so far is returned.
    seed : int
        Seed of every random choice.
    device : {"auto", "cpu", "cuda", "cuda:N"}
    valid : bool array, shape of ``projections``, optional
        False for rays that must not be used.
    callbacks : sequence of callables
        Each gets a :class:`~tomo_polysplat.fit.optimise.FitState` once a pass over the views; returning True
        ends the fit.
    progress : bool or callable, optional
        A bar on standard error (True, or None on a terminal), or a function of (share, words).
    settings : Settings or mapping, optional
        Changes of single settings by name.

    Returns
    -------
    Result
        On KeyboardInterrupt, the best state so far.

    Raises
    ------
    ValueError, TypeError
        For input that does not fit together; the message names the argument and the remedy.
    """
    started = time.perf_counter()
    chosen = make_settings(quality, settings)
    if time_budget is not None:
        time_budget = require_number("time_budget", time_budget, above=0)
    if unit not in LENGTH_UNITS:
        raise fail("unit", f"one of {', '.join(LENGTH_UNITS)}", repr(unit))
    target = _device(device)
    geometry, grid = from_astra(proj_geom, vol_geom)
    values, counts = _usable(projections, proj_geom, valid)
    polychromatic = spectrum is not None and not spectrum.is_monochromatic
    curves = Materials.of(materials) if polychromatic else None
    bar = _progress(progress)
    with _threads(target), bar as report:
        report(0.0, "start volume")
        start, about = _start_volume(
            values, geometry, grid, spectrum if polychromatic else None, unit, target
        )
        plan = make_plan(start, geometry, grid, chosen, polychromatic, target.type)
        plan.reasons["start"] = f"{about['method'].upper()}: {about['reason']}"
        scene, gaussians, spacing, rays = _set_up(
            values,
            geometry,
            grid,
            start,
            plan,
            spectrum if polychromatic else None,
            curves,
            unit,
            chosen,
            target,
        )
        if len(gaussians):
            to_volume = _volume_of(scene, plan, curves, spectrum, unit)
            outcome = fit(
                gaussians,
                spacing,
                rays,
                scene,
                chosen,
                views_per_step=plan.views_per_step,
                rng=np.random.default_rng(seed),
                started=started,
                deadline=None if time_budget is None else started + time_budget,
                volume=to_volume,
                callbacks=[
                    lambda state: report(state.share, f"held-out error {state.held_out:.2e}"),
                    *callbacks,
                ],
            )
        else:
            logger.warning("The start volume is empty: no Gaussians, a volume of zeros.")
            outcome = FitOutcome(gaussians, reason="nothing to fit: the start volume is empty")
        report(1.0, "volume")
        plan.reasons["stop"] = outcome.reason
        counts |= _counts(outcome, scene, chosen)
        result = _result(outcome, scene, grid, geometry, plan, curves, spectrum, unit)
    result.counts, result.settings = counts, chosen.to_dict() | {"seed": seed, "quality": quality}
    result.flipped_2d = is_planar_geometry(proj_geom)
    result.seconds = time.perf_counter() - started
    logger.info("Reconstructed in %.1f s: %s; %s", result.seconds, outcome.reason, counts)
    return result


def _device(name: str) -> torch.device:
    if name == "auto":
        return torch.device("cuda" if torch.cuda.is_available() else "cpu")
    try:
        device = torch.device(name)
    except RuntimeError:
        raise fail("device", "auto, cpu, cuda or cuda:N", repr(name)) from None
    if device.type not in ("cpu", "cuda"):
        raise fail("device", "auto, cpu, cuda or cuda:N", repr(name))
    if device.type == "cuda" and not torch.cuda.is_available():
        raise fail(
            "device", "a device that is there", repr(name), "torch finds no CUDA device: use device='cpu'"
        )
    return device


@contextmanager
def _threads(device: torch.device):
    """torch on one thread while a fit runs on the CPU.

    The tensors between the kernels are small: sharing them out costs more than it saves (a third of the time
    of a fit on two idle cores, and several times it on busy ones).
    """
    before = torch.get_num_threads()
    if device.type == "cpu":
        torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def _usable(projections: Any, proj_geom: Mapping[str, Any], valid: Any) -> tuple[np.ndarray, dict[str, int]]:
    """Projections (views, rows, columns) with NaN for every ray that is not to be used, and their counts."""
    values = np.array(projections_from_astra(projections, proj_geom), np.float32)
    counts = {"rays": values.size, "rays_not_finite": int(np.count_nonzero(~np.isfinite(values)))}
    if valid is not None:
        mask = require_array("valid", valid)
        require_shape("valid", mask, np.shape(projections), "of the projections")
        mask = projections_from_astra(mask.astype(np.float32), proj_geom) > 0.5
        counts["rays_marked_invalid"] = int(np.count_nonzero(~mask))
        values[~mask] = np.nan
    values[~np.isfinite(values)] = np.nan
    if np.isnan(values).all():
        raise fail("projections", "at least one usable ray", "none", "check the flat fields and the mask")
    return values, counts


def _start_volume(
    values: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    spectrum: Spectrum | None,
    unit: str,
    device: torch.device,
) -> tuple[np.ndarray, dict[str, Any]]:
    """First reconstruction: water-equivalent density in g/cm3, or attenuation in 1/unit without a spectrum."""
    if spectrum is not None:
        values = (water_equivalent(values, spectrum) / cm_per(unit)).astype(np.float32)
    return initial_volume(values, geometry, grid, device=device.type)


def _set_up(
    values: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    start: np.ndarray,
    plan: Plan,
    spectrum: Spectrum | None,
    curves: Materials | None,
    unit: str,
    settings: Settings,
    device: torch.device,
) -> tuple[FitScene, Gaussians, float, Rays]:
    """The forward model, the seeds and the rays, in the solver's coordinates."""
    planar = geometry.planar and grid.planar
    length = 0.5 * float(grid.extent[: 2 if planar else 3].max())
    inside, outside = grid.normalised(grid.centre, length), geometry.normalised(grid.centre, length)
    kernel, why = select.choose(device, settings.kernel)
    plan.reasons["kernel"] = f"{kernel}: {why}"
    quadrature, reference_curve, output_curve, scale = None, None, None, length * plan.reference
    if spectrum is not None and curves is not None:
        largest = float(np.clip(np.nanmax(values), 1.0, _LARGEST_PROJECTION))
        quadrature = fit_quadrature(spectrum, curves, max_path=largest, nodes=settings.spectral_nodes or None)
        plan.reasons["spectrum"] = quadrature.describe()
        energy = transmitted_energy(values, spectrum)
        plan.reasons["reference_energy"] = f"{energy:.1f} keV: the mean of what a typical ray transmits"
        reference_curve = _relative(curves, energy, device)
        output_curve = _relative(curves, spectrum.effective_energy, device)
        scale *= cm_per(unit)
    scene = FitScene(
        voxel_box(inside), quadrature, scale, reference_curve, output_curve, kernel, settings.cutoff
    )
    spacing = plan.spacing * float(inside.voxel_size[: 2 if planar else 3].min())
    gaussians = seed_gaussians(
        start / plan.reference, inside, spacing, settings, spectrum is not None, device
    )
    plan.reasons["gaussians"] = (
        f"{len(gaussians)}, the material number free for {int((gaussians.group < 0).sum())}"
    )
    photons = float("inf") if settings.loss == "l1" else photons_per_ray(values)
    plan.reasons["photons_per_ray"] = f"{photons:.3g}, from the scatter of neighbouring pixels"
    views = detector_views(outside, planar)
    rays = Rays(torch.from_numpy(values).to(device), views, photons, settings.model_error, settings.held_out)
    return scene, gaussians, spacing, rays


def _relative(curves: Materials, energy: float, device: torch.device) -> torch.Tensor:
    """(3,) mass attenuation of the curves over that of the first."""
    attenuation = curves.mass_attenuation([energy])[:, 0]
    return torch.as_tensor(attenuation / attenuation[0], dtype=torch.float32, device=device)


def _volume_of(
    scene: FitScene, plan: Plan, curves: Materials | None, spectrum: Spectrum | None, unit: str
) -> Callable[[Gaussians], np.ndarray]:
    """A function from Gaussians to the volume in 1/unit, for callbacks."""
    factor = plan.reference
    if curves is not None and spectrum is not None:
        factor *= float(curves.mass_attenuation([spectrum.effective_energy])[0, 0]) * cm_per(unit)

    def volume(gaussians: Gaussians) -> np.ndarray:
        with torch.no_grad():
            return scene.attenuation(gaussians, scene.box).cpu().numpy() * np.float32(factor)

    return volume


def _counts(outcome: FitOutcome, scene: FitScene, settings: Settings) -> dict[str, int]:
    """What was skipped or held at a bound."""
    gaussians = outcome.gaussians
    return {
        "gaussians": len(gaussians),
        "gaussians_at_zero": int((gaussians.attenuation <= 0).sum()),
        "pairs_skipped_at_source": outcome.skipped_pairs,
    }


def _result(
    outcome: FitOutcome,
    scene: FitScene,
    grid: VolumeGrid,
    geometry: Geometry,
    plan: Plan,
    curves: Materials | None,
    spectrum: Spectrum | None,
    unit: str,
) -> Result:
    """Volumes and Gaussians in the caller's unit."""
    gaussians = outcome.gaussians
    planar = geometry.planar and grid.planar
    length = 0.5 * float(grid.extent[: 2 if planar else 3].max())
    with torch.no_grad():
        basis = scene.basis(gaussians).cpu().numpy() * np.float32(plan.reference)
        heights = gaussians.weights(scene.reference_curve).sum(dim=0)
        parts = {
            "position": gaussians.position.cpu().numpy() * length + grid.centre,
            "scale": gaussians.scale().cpu().numpy() * length,
            "rotation": torch.nn.functional.normalize(gaussians.rotation, dim=1).cpu().numpy(),
            "density": heights.cpu().numpy() * plan.reference,
            "u": gaussians.material().cpu().numpy(),
        }
    return Result(
        basis,
        grid,
        unit=unit,
        energy_kev=None if spectrum is None else spectrum.effective_energy,
        materials=curves,
        spectrum=spectrum,
        gaussians=parts,
        history=outcome.history,
        plan=plan.reasons,
    )


@contextmanager
def _progress(wanted: bool | Callable[[float, str], Any] | None):
    """A function of (share, words) for the length of a run."""
    if callable(wanted):
        yield wanted
        return
    from tqdm import tqdm

    disable = None if wanted is None else not wanted
    with tqdm(
        total=1.0, bar_format="{l_bar}{bar:24}| {elapsed} {postfix}", disable=disable, leave=False
    ) as bar:

        def report(share: float, words: str) -> None:
            bar.set_postfix_str(words, refresh=False)
            bar.update(max(0.0, share - bar.n))

        yield report

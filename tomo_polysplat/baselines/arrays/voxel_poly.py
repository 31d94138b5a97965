"""The polychromatic voxel grid: our physics, weights, loss, total variation and stopping rule, without Gaussians.

It is the rival that tells what the Gaussians themselves are worth.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch

from tomo_polysplat.baselines.arrays.voxel_model import VoxelModel, start_voxels
from tomo_polysplat.fit.adam import Adam
from tomo_polysplat.fit.loss import misfits_of_step, total_variation
from tomo_polysplat.fit.problem import OPAQUE
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.step import held_out_mean
from tomo_polysplat.fit.stopping import FitState, Watch, is_true, usual_patience
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.quadrature import fit_quadrature
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.transmission import polychromatic_projection
from tomo_polysplat.physics.water import areal_density, transmitted_energy
from tomo_polysplat.plan.decisions.tv_corner import tv_corners
from tomo_polysplat.render.renderer import detector_views
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.scan.noise import ray_noise
from tomo_polysplat.settings import Settings, make_settings
from tomo_polysplat.start.agreement import halves_agree
from tomo_polysplat.start.initial import initial_volume
from tomo_polysplat.start.voxel_projector import ProjectorPair, project_voxels, projector_pair
from tomo_polysplat.units import cm_per

__all__ = ["voxel_poly"]

# Of a run that nobody has given a length.
_PASSES = 10.0
VIEWS_PER_STEP = 4
RATE_ATTENUATION, RATE_MATERIAL = 3e-2, 3e-3  # per step of Adam, falling like those of the Gaussians


# One parameter for each option that a caller names.
def voxel_poly(
    projections: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    spectrum: Spectrum,
    *,
    unit: str = "cm",
    materials: Materials | None = None,
    settings: Settings | Mapping[str, Any] | None = None,
    time_budget: float | None = None,
    seed: int = 0,
    callbacks: Sequence[Callable[[FitState], Any]] = (),
    device: str = "cpu",
) -> np.ndarray:
    """Fit a density and, near dense matter, a material number to every voxel.

    Parameters
    ----------
    projections : (views, rows, columns) float32
        ``-log(I / I0)``, NaN where not measured.
    geometry, grid : Geometry, VolumeGrid
        Lengths in ``unit``.
    spectrum : Spectrum
    unit : str
    materials : Materials, optional
    settings : Settings or mapping, optional
        Of the fit with Gaussians; what is said of rays, materials, loss and length of the run holds here too.
    time_budget : float, optional
        Seconds, the first reconstruction included.
    seed : int
        Of the order of the views.
    callbacks : sequence of callables
        Get a `FitState` once a pass over the views; returning True ends the fit.
    device : {"cpu", "cuda", "cuda:N"}

    Returns
    -------
    (nz, ny, nx) float32
        Attenuation in 1/unit at the effective energy, of the state that the stopping rule keeps.

    Raises
    ------
    FloatingPointError
        If the fit diverges in its first pass.
    """
    started = time.perf_counter()
    chosen = settings if isinstance(settings, Settings) else make_settings(changes=dict(settings or {}))
    target = torch.device(device)
    start, _ = initial_volume(
        (areal_density(projections, spectrum) / cm_per(unit)).astype(np.float32),
        geometry,
        grid,
        device=device,
    )
    model = start_voxels(start, grid, chosen, target)
    with projector_pair(geometry, grid, target) as pair:
        fit = _Fit(projections, geometry, grid, spectrum, materials or Materials(), unit, model, pair, chosen)
        deadline = None if time_budget is None else started + time_budget
        best = fit.run(np.random.default_rng(seed), started, deadline, callbacks)
        return fit.volume(best)


class _Fit:
    """Rays, physics and optimiser of one run."""

    # One parameter for each option that a caller names.
    def __init__(
        self,
        projections: np.ndarray,
        geometry: Geometry,
        grid: VolumeGrid,
        spectrum: Spectrum,
        materials: Materials,
        unit: str,
        model: VoxelModel,
        pair: ProjectorPair,
        settings: Settings,
    ) -> None:
        self.model, self.pair, self.settings, self.cm = model, pair, settings, cm_per(unit)
        values = np.where(np.isfinite(projections), projections, np.float32(np.nan))
        largest = float(np.clip(np.nanmax(values), 1.0, OPAQUE))
        self.quadrature = fit_quadrature(spectrum, materials, largest, settings.spectral_nodes)
        target = model.relative.device
        energies = [transmitted_energy(values, spectrum), spectrum.effective_energy]
        curves = materials.mass_attenuation(energies)
        self.water = float(curves[0, 1]) * self.cm
        relative = torch.as_tensor(curves / curves[:1], dtype=torch.float32, device=target)
        self.reference_curve, self.output_curve = relative[:, 0], relative[:, 1]
        noise = ray_noise(values)
        self.rays = Rays(
            torch.from_numpy(values).to(target),
            detector_views(geometry, geometry.planar),
            noise.photons,
            math.hypot(settings.model_error, noise.deviation),
            settings.held_out,
            deviation=noise.deviation,
        )
        measured = self.rays.projections
        self.corners, _ = tv_corners(
            model.relative * model.size,
            settings,
            lambda bodies: halves_agree(measured, geometry, grid, bodies),
        )
        self.adam = Adam({"attenuation": model.relative, "material": model.own})

    def run(
        self,
        rng: np.random.Generator,
        started: float,
        deadline: float | None,
        callbacks: Sequence[Callable[[FitState], Any]],
    ) -> VoxelModel:
        """The model that the stopping rule keeps; see ``fit.stopping.Watch``."""
        begun, step = time.perf_counter(), 0
        groups = _interleaved(len(self.rays.views))
        passes = self.settings.passes or _PASSES
        steps = math.ceil(passes * len(groups))
        watch: Watch[VoxelModel] = Watch(self.settings.patience or usual_patience(passes))

        def share() -> float:
            used = 0.0 if deadline is None else (time.perf_counter() - begun) / max(deadline - begun, 1e-9)
            return max(step / steps, used)

        while share() < 1:
            errors = []
            for group in rng.permutation(len(groups)):
                if share() >= 1:
                    break
                errors.append(self._step(groups[group], share()))
                step += 1
            if not errors:
                break
            loss, aside, weight = torch.stack(errors).sum(dim=0).tolist()
            loss, held_out = loss / len(errors), held_out_mean(aside, weight, self.rays.typical_weight)
            seconds = time.perf_counter() - started
            state = FitState(seconds, step, 0, loss, held_out, share(), lambda: self.volume(self.model))
            ended = bool(watch.judge(state, self.model))
            if any([is_true(callback(state)) for callback in callbacks]) or ended:
                break
        return watch.best or self.model.copy()

    def _step(self, views: np.ndarray, share: float) -> torch.Tensor:
        """One step of Adam; misfit of the fitted rays, of the held-out ones times their weight, and this."""
        falling = self.settings.final_rate**share
        _, measured, weight, aside = self.rays.batch(views)
        weights = self.model.weights(self.reference_curve)
        areal = project_voxels(weights, self.pair, views) * self.cm
        predicted = polychromatic_projection(areal, self.quadrature)
        fitted, *held_out = misfits_of_step(predicted, measured, weight, aside, self.settings)
        rough = total_variation(self._output(weights), self.corners, self.settings.bone_level)
        self.adam.forget_gradients()
        (fitted + self.settings.tv_weight * rough).backward()
        self.adam.step({"attenuation": RATE_ATTENUATION * falling, "material": RATE_MATERIAL * falling})
        self.model.hold()
        return torch.stack([torch.as_tensor(part) for part in (fitted.detach(), *held_out)])

    def _output(self, weights: torch.Tensor) -> torch.Tensor:
        """(nz, ny, nx) attenuation at the effective energy in soft references."""
        return torch.einsum("k,kzyx->zyx", self.output_curve, weights)

    @torch.no_grad()
    def volume(self, model: VoxelModel) -> np.ndarray:
        """(nz, ny, nx) attenuation in 1/unit."""
        return self._output(model.weights(self.reference_curve)).cpu().numpy() * np.float32(self.water)


def _interleaved(views: int) -> list[np.ndarray]:
    """All views in groups of about ``VIEWS_PER_STEP``, each spread over the whole scan."""
    count = -(-views // VIEWS_PER_STEP)
    return [np.arange(first, views, count) for first in range(count)]

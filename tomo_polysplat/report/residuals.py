"""How well a result explains the rays it was made from: residuals in units of each ray's noise."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from tomo_polysplat.checks import fail
from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.kernels.project.autograd import project
from tomo_polysplat.kernels.select import choose, pick_fast_device
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.model.gaussians import shares_of_curves
from tomo_polysplat.parallel import kept_threads
from tomo_polysplat.physics.detector_blur import LARGEST_BLUR, blurred, blurred_light
from tomo_polysplat.physics.filter_map import FilterMap
from tomo_polysplat.physics.pixel_light import averaged_light
from tomo_polysplat.physics.scatter import light_around
from tomo_polysplat.render.renderer import RAY_CUTOFF, detector_views
from tomo_polysplat.report.decided import RayPhysics, ray_physics
from tomo_polysplat.report.held_out import HeldOut
from tomo_polysplat.report.where import MisfitMap
from tomo_polysplat.result.filter_found import filter_of
from tomo_polysplat.result.residuals import Residuals
from tomo_polysplat.scan.geometry import from_astra, is_planar_geometry
from tomo_polysplat.scan.noise import RayNoise, ray_noise
from tomo_polysplat.scan.usable import usable_rays
from tomo_polysplat.transfer import to_device
from tomo_polysplat.units import cm_per

if TYPE_CHECKING:
    from tomo_polysplat.result.data import ResultData
    from tomo_polysplat.scan.scan import Scan

__all__ = ["MOST_VIEWS", "residuals_of"]

# Views that are looked at, evenly spread over the scan, and together; and pixels of the map along an edge.
MOST_VIEWS, _AT_ONCE, _MAP = 180, 4, 192
# Rays times energies that are held at once.
_NUMBERS = 1 << 26
# A ray this many deviations off is not explained.
_FAR = 3.0
# What an ASTRA geometry has for each view.
_BY_VIEW = ("ProjectionAngles", "Vectors")


@kept_threads()
def residuals_of(
    result: ResultData, scan: Scan, *, device: str = "auto", most_views: int = MOST_VIEWS
) -> Residuals:
    """Project the Gaussians of a result along the rays of its scan, and compare.

    The noise is that of `scan.noise.ray_noise`, with P as the model has it. The detector's blur and scatter count as
    the plan tells of them. Saturated rays are left out.

    Parameters
    ----------
    result : Result
    scan : Scan
        What it was made from.
    device : {"auto", "cpu", "cuda", "cuda:N"}
    most_views : int
        At most so many, evenly spread.

    Raises
    ------
    ValueError
        If the scan has another volume or unit than the result, or this has no Gaussians.
    """
    if not result.gaussians:
        raise fail("result", "one with its Gaussians", "a volume alone")
    if scan.volume_shape != result.grid.shape or scan.unit != result.unit:
        got = f"a volume of {scan.volume_shape} in {scan.unit}"
        wanted = f"the scan of the result, {result.grid.shape} in {result.unit}"
        raise fail("scan", wanted, got)
    spectrum = result.spectrum if result.materials is not None else None
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    chosen = evenly_spread(geometry.views, most_views)
    values = _OfViews(result, scan, np.union1d(chosen, HeldOut.views_told_by_values(geometry, grid)))
    # Where the scanner stood, if the fit has moved it.
    seen = geometry if result.geometry is None else from_astra(result.geometry, scan.vol_geom)[0]
    some = seen.select(chosen)
    planar = is_planar_geometry(scan.proj_geom) or geometry.planar
    filters = None if spectrum is None else filter_of(result, scan)
    behind = None if filters is None else FilterMap.of(filters, scan.unit, geometry.rows, geometry.columns)
    model = _Model(result, detector_views(some, planar), pick_fast_device(device), behind)
    share = float(result.settings.get("held_out", 0.0))
    unseen = HeldOut(geometry, grid, values, share, model.device)
    noise = ray_noise(values.array, model.dimmed, model.device, values.given)
    return _collected(model, values[chosen], chosen, noise, MisfitMap(some, grid), unseen)


class _OfViews:
    """Rays (rows, columns) of some views by their number in the scan, less gains and drift that the fit took out.

    The other views are not read: of a scan that lies in its file they would take longer than all that follows.
    """

    def __init__(self, result: ResultData, scan: Scan, views: np.ndarray) -> None:
        spectrum = result.spectrum if result.materials is not None else None
        correction = scan.water_correction if spectrum is not None else None
        usable = scan.usable
        valid = None if usable is None else usable[:, views]
        told = {name: np.asarray(scan.proj_geom[name])[views] for name in _BY_VIEW if name in scan.proj_geom}
        some = dict(scan.proj_geom) | told
        self.array, _, self.given = usable_rays(scan.projections[:, views], some, valid, correction, spectrum)
        if 0.0 in self.given:
            # A saturated camera tells a bound, which is no measurement.
            self.array[self.array == 0] = np.nan
        measured = np.ones(self.array.shape, bool) if self.given else True
        for value in self.given:
            measured &= self.array != value
        self._views = views
        drift = None if result.drift is None else np.asarray(result.drift)[views]
        for part, shape in ((result.gains, self.array.shape[1:]), (drift, (len(views), 1, 1))):
            if part is not None:
                taken = np.asarray(part, self.array.dtype).reshape(shape)
                np.subtract(self.array, taken, out=self.array, where=measured)

    def __getitem__(self, views: Any) -> np.ndarray:
        return self.array[np.searchsorted(self._views, views)]


class _Model:
    """Predicts -log(I/I0) of some views from the Gaussians of a result."""

    def __init__(
        self, result: ResultData, views: DetectorViews, device: torch.device, behind: FilterMap | None = None
    ) -> None:
        self.views, self.device = views, device
        self.kernel, _ = choose(device)
        self.physics: RayPhysics = ray_physics(result.plan)
        parts = {name: np.asarray(part, np.float32) for name, part in result.gaussians.items()}
        dims = 2 if views.planar else 3
        arrays = (
            parts["position"],
            parts["scale"][:, :dims],
            parts["rotation"],
            parts["density"][None],
            parts["u"],
        )
        *where, weight, u = (to_device(np.ascontiguousarray(array), device) for array in arrays)
        self.gaussians = [*where, weight if result.materials is None else weight * shares_of_curves(u)]
        self.lines = self._spectral_lines(result)
        self.dimmed = None
        self.behind: tuple[torch.Tensor, ...] = ()
        if behind is not None and result.spectrum is not None:
            self.dimmed = behind.dimmed(result.spectrum)
            known = (behind.attenuation(result.spectrum.energies), behind.areal, self.dimmed)
            self.behind = tuple(torch.from_numpy(np.asarray(a, np.float32)).to(device) for a in known)

    def _spectral_lines(self, result: ResultData) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Logarithm of the weights, and attenuation (energies, curves) of densities times lengths in the unit."""
        if result.materials is None or result.spectrum is None:
            return None
        curves = result.materials.mass_attenuation(result.spectrum.energies).T * cm_per(result.unit)
        logs = np.log(np.maximum(result.spectrum.weights / result.spectrum.weights.sum(), 1e-30))
        tensors = (torch.from_numpy(np.asarray(a, np.float32)).to(self.device) for a in (logs, curves))
        return next(tensors), next(tensors)

    @torch.no_grad()
    def predict(self, some: np.ndarray, measured: torch.Tensor) -> torch.Tensor:
        """(views, rows, columns) of the views `some`, whose measured values tell how scatter varies."""
        views, parts = self.views.select(some), self.physics.pixel_rays
        fine = views if parts == 1 else views.finer(parts)
        position, scale, rotation, weight = self.gaussians
        areal, _ = project(position, scale, rotation, weight, fine, kernel=self.kernel, cutoff=RAY_CUTOFF)
        if self.lines is None:
            values = areal[0]
        else:
            logs, curves = self.lines
            if self.behind:
                # One curve more, whose areal density each pixel tells.
                filters = self.behind[1].repeat_interleave(fine.rows // views.rows, 0)
                filters = filters.repeat_interleave(fine.columns // views.columns, 1)
                areal = torch.cat([areal, filters.expand(1, *areal.shape[1:])])
                curves = torch.cat([curves, self.behind[0][:, None]], dim=1)
            flat = areal.reshape(areal.shape[0], -1)
            # A few rays at a time, for each has a number for every energy.
            parted = flat.split(max(1, _NUMBERS // len(logs)), dim=1)
            lights = [torch.logsumexp(logs[:, None] - curves @ part, dim=0) for part in parted]
            values = -torch.cat(lights).reshape(areal.shape[1:])
        if parts > 1:
            values = averaged_light(values, views.rows, views.columns)
        if self.physics.scatter or self.physics.of_light:
            around = light_around(measured + float(np.log(self.physics.beam)))
            scatter = self.physics.scatter + self.physics.of_light * around
            values = -torch.log(torch.exp(-values) + scatter.clamp(min=0))
        if self.physics.beam != 1.0:
            values = values - float(np.log(self.physics.beam))
        if self.behind:
            # Relative to the open beam behind the filter.
            values = values - self.behind[2]
        variance = values.new_tensor([min(max(self.physics.blur, 0.0), LARGEST_BLUR)])
        if not self.physics.blur > 0:
            return values
        return (blurred_light if parts > 1 else blurred)(values, variance)


def _collected(
    model: _Model,
    values: np.ndarray,
    chosen: np.ndarray,
    noise: RayNoise,
    where: MisfitMap,
    unseen: HeldOut,
) -> Residuals:
    # How many, their sum, the sum of their squares; of a view, squares and number of all rays, and of those held out.
    pixels = torch.zeros((3, *values.shape[1:]), dtype=torch.float64, device=model.device)
    sums, near = np.zeros((4, len(chosen))), 0
    for first in range(0, len(chosen), _AT_ONCE):
        some = np.arange(first, min(first + _AT_ONCE, len(chosen)))
        scaled, good = _scaled(model, some, values[some], noise)
        squares = scaled**2
        for total, part in zip(pixels, (good, scaled, squares)):
            total += part.sum(dim=0)
        where.add(some, squares, good)
        aside = good & unseen.of(chosen[some])
        parts = (squares, good, torch.where(aside, squares, 0.0), aside)
        sums[:, some] = (
            torch.stack([part.sum(dim=(1, 2), dtype=torch.float64) for part in parts]).cpu().numpy()
        )
        near += int((good & (scaled.abs() < _FAR)).sum())
    # The sums by pixel, coarser.
    block = max(1, -(-max(values.shape[1:]) // _MAP))
    number, total, of_squares = (_blocks(part, block) for part in pixels.cpu().numpy())
    rays = int(number.sum())
    bias = np.divide(total, number, out=np.full(number.shape, np.nan), where=number > 0)
    by_view, held_out = _root_mean(*sums[:2]), _root_mean(*sums[2:])
    totals = sums.sum(axis=1)
    rms, rms_held_out = (float(_root_mean(totals[k], totals[k + 1])) for k in (0, 2))
    maps = by_view, _root_mean(of_squares, number), bias, held_out
    within, photons = near / max(rays, 1), noise.photons
    found = Residuals(chosen, *maps, rms, within, rms_held_out, rays, photons, *where.worst(), block)
    return replace(found, deviation=noise.deviation)


def _scaled(
    model: _Model, some: np.ndarray, values: np.ndarray, noise: RayNoise
) -> tuple[torch.Tensor, torch.Tensor]:
    """Residuals of some views in units of noise, 0 where a ray is not usable, and where one is."""
    measured = torch.from_numpy(np.ascontiguousarray(values)).to(model.device)
    predicted = model.predict(some, measured)
    depth = predicted + model.behind[2] if model.behind else predicted
    deviation = noise.variance(depth).sqrt() if noise.shows else 1.0
    scaled = ((predicted - measured) / deviation).double()
    good = torch.isfinite(scaled)
    return torch.where(good, scaled, 0.0), good


def _root_mean(squares: np.ndarray, number: np.ndarray) -> np.ndarray:
    return np.sqrt(np.divide(squares, number, out=np.full(np.shape(number), np.nan), where=number > 0))


def _blocks(image: np.ndarray, block: int) -> np.ndarray:
    """Sums over square blocks of pixels; the last ones may be smaller."""
    if block == 1:
        return image
    rows, columns = (np.arange(0, length, block) for length in image.shape)
    return np.add.reduceat(np.add.reduceat(image, rows, axis=0), columns, axis=1)

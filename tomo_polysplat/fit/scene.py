"""Everything fixed about one fit: geometry in the solver's coordinates, physics, kernel."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch

from tomo_polysplat.fit.memory import voxels_at_once
from tomo_polysplat.fit.slabs import on_host
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.physics.detector_blur import blurred, blurred_light
from tomo_polysplat.physics.filter_slope import filter_slope
from tomo_polysplat.physics.pixel_light import averaged_light
from tomo_polysplat.physics.quadrature import Quadrature
from tomo_polysplat.physics.transmission import polychromatic_projection
from tomo_polysplat.render.metal_edges import HALO, tail_factors, tails
from tomo_polysplat.render.renderer import project_gaussians, voxelise_gaussians, voxelise_means
from tomo_polysplat.transfer import to_host

__all__ = ["FitScene"]

# One slice in this many is made to tell how long all of them take. That time is multiplied by the second number: the
# Gaussians of the end are thinner than those of the start, and a host's memory is slower when it is new.
_SLICES_TIMED, _SLACK = 8, 2.0


@dataclass(frozen=True)
class FitScene:
    """The forward model of a fit.

    Parameters
    ----------
    box : VoxelBox
        All voxels, in the solver's coordinates.
    quadrature : Quadrature or None
        Nodes of the spectrum, for three curves or for the first alone; None for a model of one energy.
    areal_scale : float
        Line integral in the solver's units (length times density) to g/cm2, or to -log(I/I0) for one energy.
    reference_curve, output_curve : (3,) tensor or None
        Mass attenuation of the curves over that of the first, at the reference energy of the Gaussians and at
        the energy of the volume; None for a model of one curve, whose own these are.
    least_u : float
        Least material number; see ``physics.material_range``.
    kernel : str
    metal_tail : float
        Share of the metal around a voxel that some point of it has to come near to; see ``render.metal_edges``.
    blurring : bool
        Whether rays are seen through the detector's blur; see ``physics.detector_blur``.
    tv_corners : pair of float
        Difference of neighbouring voxels, in soft references, up to which it counts in full: of soft matter, and where
        one of the two is bone-like or denser.
    closed : bool
        Whether all matter lies within the voxels, so that no Gaussian may leave them; see ``fit.inside``.
    tv_every : int
        In every how many steps the volume's total variation is taken, and counts as many times.
    smallest_scale : float
        Smallest deviation of a Gaussian, in voxels, or in spacings of the seeds where these are closer.
    pixel_rays : int
        Rays a pixel and axis over which the light is averaged; see ``physics.pixel_light``.
    light_u : float
        Material number of light soft matter, less that of the rest; see ``fit.light_matter``.
    behind : (2, rows, columns) tensor or None
        Areal density (g/cm2) of the filter that each pixel is behind, and P of the nodes through it alone; see
        ``physics.filter_map``.
    solid_number : callable or None
        Material numbers of solids by their attenuation in soft references; None where that does not tell them.
    """

    box: VoxelBox
    quadrature: Quadrature | None
    areal_scale: float
    reference_curve: torch.Tensor | None
    output_curve: torch.Tensor | None
    least_u: float
    kernel: str
    metal_tail: float
    blurring: bool
    tv_corners: tuple[float, float]
    closed: bool
    tv_every: int
    smallest_scale: float
    pixel_rays: int = 1
    light_u: float = 0.0
    solid_number: Callable[[np.ndarray], np.ndarray] | None = None
    behind: torch.Tensor | None = None

    def fine(self, views: DetectorViews) -> DetectorViews:
        """The rays whose light the pixels of these views average."""
        return views if self.pixel_rays == 1 else views.finer(self.pixel_rays)

    def projections(
        self,
        gaussians: Gaussians,
        views: DetectorViews,
        vectors: torch.Tensor | None = None,
        of_all: Callable[[torch.Tensor], torch.Tensor] | None = None,
    ) -> tuple[torch.Tensor, int]:
        """(views, rows, columns) predicted -log(I/I0), and the pairs skipped at the source plane.

        ``vectors`` of these views, as `render.renderer.project_gaussians` takes them, go with one ray a pixel only.
        ``of_all`` adds to the line integrals those of Gaussians that other ranks hold.
        """
        weights = gaussians.weights(self.reference_curve)
        rays = self.fine(views)
        areal, skipped = project_gaussians(gaussians, weights, rays, self.kernel, vectors)
        areal = (areal if of_all is None else of_all(areal)) * self.areal_scale
        sharp = self._seen(areal)
        if self.pixel_rays > 1:
            sharp = averaged_light(sharp, views.rows, views.columns)
        if not self.blurring:
            return sharp, skipped
        return (blurred_light if self.pixel_rays > 1 else blurred)(sharp, gaussians.blur), skipped

    def _seen(self, areal: torch.Tensor) -> torch.Tensor:
        """(views, rows, columns) -log(I/I0) of rays with these (curves, views, rows, columns) areal densities."""
        if self.quadrature is None:
            return areal[0]
        if self.behind is None:
            return polychromatic_projection(areal, self.quadrature)
        parts = [fine // whole for fine, whole in zip(areal.shape[2:], self.behind.shape[1:])]
        filters, alone = self.behind.repeat_interleave(parts[0], 1).repeat_interleave(parts[1], 2)
        return polychromatic_projection(areal, self.quadrature, filters) - alone

    def filter_slopes(
        self, gaussians: Gaussians, views: DetectorViews, quadrature: Quadrature
    ) -> torch.Tensor:
        """(views, rows, columns) derivative of -log(I/I0) by the areal density of each pixel's filter, in cm2/g.

        ``quadrature`` has nodes that know the filter; rays are infinitely thin, and not blurred.
        """
        weights = gaussians.weights(self.reference_curve)
        areal, _ = project_gaussians(gaussians, weights, views, self.kernel)
        behind = areal.new_zeros(areal.shape[2:]) if self.behind is None else self.behind[0]
        return filter_slope(areal * self.areal_scale, quadrature, behind)

    def as_if_bare(self, areal: torch.Tensor, measured: torch.Tensor) -> torch.Tensor:
        """Rays in front of no filter with as much more or less light, of the whole beam, than the model has."""
        if self.quadrature is None or self.behind is None:
            return measured
        bare = torch.exp(-polychromatic_projection(areal, self.quadrature))
        open_beam = torch.exp(-self.behind[1])
        excess = open_beam * (torch.exp(-measured) - torch.exp(-self._seen(areal)))
        return -torch.log((bare + excess).clamp(min=torch.finfo(bare.dtype).tiny))

    def keep_within(self, gaussians: Gaussians) -> None:
        """Move Gaussians that have left a closed volume back to its faces."""
        if not self.closed:
            return
        lower = self.box.first - 0.5 * self.box.spacing
        upper = lower + np.array(self.box.shape[::-1]) * self.box.spacing
        ends = (gaussians.position.new_tensor(end) for end in (lower, upper))
        gaussians.position.clamp_(*ends)

    def attenuation(self, gaussians: Gaussians, box: VoxelBox) -> torch.Tensor:
        """(nz, ny, nx) attenuation at the effective energy in soft references, at voxel centres."""
        return voxelise_gaussians(gaussians, self._output_weights(gaussians), box, self.kernel)[0]

    def volume(self, gaussians: Gaussians) -> torch.Tensor:
        """(nz, ny, nx) attenuation at the effective energy in soft references, means over the voxels."""
        return self._means(gaussians, self._output_weights(gaussians))[0]

    def basis(self, gaussians: Gaussians) -> torch.Tensor:
        """(channels, nz, ny, nx) densities of the curves in soft references, means over the voxels."""
        return self._means(gaussians, gaussians.weights(self.reference_curve))

    def volume_on_host(self, gaussians: Gaussians, factor: float, most: int | None = None) -> np.ndarray:
        """`volume` times a factor, made by slabs (`fit.slabs`), of ``most`` voxels or what there is room for."""
        return self._by_slabs(gaussians, "volume", factor, 1, most)[0]

    def basis_on_host(self, gaussians: Gaussians, factor: float, most: int | None = None) -> np.ndarray:
        """`basis` times a factor, likewise."""
        channels = 1 if self.reference_curve is None else len(self.reference_curve)
        return self._by_slabs(gaussians, "basis", factor, channels, most)

    def _by_slabs(
        self, gaussians: Gaussians, name: str, factor: float, channels: int, most: int | None
    ) -> np.ndarray:
        # Without metal a voxel depends on no other one.
        halo = HALO if bool((gaussians.group > 0).any()) else 0
        # No other rank asks what solid there is.
        make = _Slices(replace(self, solid_number=None), gaussians, name, factor)
        place = gaussians.position.device
        return on_host(make, channels, self.box.shape, place, halo=halo, most=most)

    @torch.no_grad()
    def seconds_of_basis(self, gaussians: Gaussians) -> float:
        """How long `basis`, and attenuation from it, will take on the host at most, told by some slices in the middle.

        Two numbers of slices are timed, one twice the other, as part of the time does not depend on how many there are.
        Where the fewer took longer, because kernels were compiled, they are timed again.
        """
        nz, ny, nx = self.box.shape
        # The larger of both numbers of slices has to fit into memory, as a slab of the volume does.
        room = voxels_at_once(gaussians.position.device) // (2 * ny * nx)
        depth = max(1, min(-(-nz // _SLICES_TIMED), room))

        def seconds(some: int) -> float:
            part = replace(self, box=self.box.part(((nz - some) // 2, 0, 0), (some, ny, nx)))
            begun = time.perf_counter()
            host = to_host(part.basis(gaussians))
            # As the result does: it looks for what no matter is as dense as, and mixes the curves at one energy.
            host.max(initial=0.0)
            np.tensordot(np.ones(len(host), np.float32), host, axes=1)
            return time.perf_counter() - begun

        twice = min(2 * depth, nz)
        few, more = seconds(depth), seconds(twice)
        if few > more:
            few = seconds(depth)
        a_slice = max(more - few, 0.0) / max(twice - depth, 1)
        return _SLACK * (more + a_slice * (nz - twice))

    def _means(self, gaussians: Gaussians, weights: torch.Tensor) -> torch.Tensor:
        """Means over the voxels, with the tails of metal put back inside it."""
        metal = gaussians.group > 0
        box = replace(self.box, levels=self.box.levels * self.pixel_rays)
        chosen = [flag.nonzero()[:, 0] for flag in (~metal, metal)]
        rest, inside = (
            voxelise_means(gaussians.select(index), weights[:, index], box, self.kernel) for index in chosen
        )
        seen, some = self._visible(inside), gaussians.select(chosen[1])
        tail = tails(seen, some, self._output_weights(some), box, self.kernel, self.metal_tail)
        return rest + inside * tail_factors(seen, self._visible(rest), tail)

    def _visible(self, densities: torch.Tensor) -> torch.Tensor:
        """(nz, ny, nx) attenuation at the effective energy, of (channels, nz, ny, nx) densities or of itself."""
        if len(densities) == 1 or self.output_curve is None:
            return densities[0]
        return torch.einsum("k,kzyx->zyx", self.output_curve, densities)

    def _output_weights(self, gaussians: Gaussians) -> torch.Tensor:
        weights = gaussians.weights(self.reference_curve)
        return weights if self.output_curve is None else self.output_curve[None] @ weights


@dataclass(frozen=True)
class _Slices:
    """What makes slices of a volume of Gaussians, `FitScene.basis` or `FitScene.volume`, times a factor."""

    scene: FitScene
    gaussians: Gaussians
    name: str
    factor: float

    def __call__(self, first: int, last: int) -> torch.Tensor:
        """(channels, slices, ny, nx) of those from the first up to, and without, the last."""
        box = self.scene.box.part((first, 0, 0), (last - first, *self.scene.box.shape[1:]))
        values: torch.Tensor = getattr(replace(self.scene, box=box), self.name)(self.gaussians)
        return values.reshape(-1, *box.shape) * self.factor

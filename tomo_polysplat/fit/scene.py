"""Everything fixed about one fit: geometry in the solver's coordinates, physics, kernel."""

from __future__ import annotations

from dataclasses import dataclass

import torch

from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.physics.quadrature import Quadrature
from tomo_polysplat.physics.transmission import polychromatic_projection
from tomo_polysplat.render.renderer import project_gaussians, voxelise_gaussians

__all__ = ["FitScene"]


@dataclass(frozen=True)
class FitScene:
    """The forward model of a fit.

    Parameters
    ----------
    box : VoxelBox
        All voxels, in the solver's coordinates.
    quadrature : Quadrature or None
        Nodes of the spectrum; None for a monochromatic model.
    areal_scale : float
        Line integral in the solver's units (length times density) to g/cm2, or to -log(I/I0) when
        monochromatic.
    curve : (3,) or (1,) tensor
        Mass attenuation of the curves at the effective energy over that of the first.
    kernel : str
    cutoff : float
    """

    box: VoxelBox
    quadrature: Quadrature | None
    areal_scale: float
    curve: torch.Tensor
    kernel: str
    cutoff: float

    @property
    def polychromatic(self) -> bool:
        """Whether energies differ."""
        return self.quadrature is not None

    def projections(self, gaussians: Gaussians, views: DetectorViews) -> tuple[torch.Tensor, int]:
        """(views, rows, columns) predicted -log(I/I0), and the pairs skipped at the source plane."""
        weights = gaussians.weights(self.polychromatic)
        areal, skipped = project_gaussians(gaussians, weights, views, self.kernel, self.cutoff)
        areal = areal * self.areal_scale
        if self.quadrature is None:
            return areal[0], skipped
        return polychromatic_projection(areal, self.quadrature), skipped

    def attenuation(self, gaussians: Gaussians, box: VoxelBox) -> torch.Tensor:
        """(nz, ny, nx) attenuation at the effective energy in soft references."""
        height = (self.curve[:, None] * gaussians.weights(self.polychromatic)).sum(dim=0, keepdim=True)
        return voxelise_gaussians(gaussians, height, box, self.kernel)[0]

    def basis(self, gaussians: Gaussians) -> torch.Tensor:
        """(channels, nz, ny, nx) densities of the curves in soft references."""
        return voxelise_gaussians(gaussians, gaussians.weights(self.polychromatic), self.box, self.kernel)

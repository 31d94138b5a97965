"""One scan as the solver sees it: its own coordinates, rays that cannot be used taken out.

The solver's coordinates are relative to the volume's centre in units of half its longest side. Everything from
the first reconstruction on happens in them, so that no choice, and not even rounding, depends on the unit.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import torch

from tomo_polysplat.checks import require_choice
from tomo_polysplat.fit.host_rays import HostRays
from tomo_polysplat.fit.inside import matter_is_inside
from tomo_polysplat.fit.memory import projections_stay
from tomo_polysplat.fit.surroundings import NO_MARGIN, Margin, surroundings_of
from tomo_polysplat.fit.taken_out import Step, TakenOut
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.filter_map import FilterMap
from tomo_polysplat.physics.scatter import Scatter, made_level, without_scatter
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.scan.noise import RayNoise, correlation_of_noise, ray_noise
from tomo_polysplat.scan.snapped import snapped_geometry, snapped_grid
from tomo_polysplat.scan.view_order import sorted_in_place, view_order
from tomo_polysplat.start.agreement import halves_agree
from tomo_polysplat.units import LENGTH_UNITS, cm_per

__all__ = ["OPAQUE", "Problem"]

logger = logging.getLogger(__name__)

_HOST = torch.device("cpu")
# Beyond this a ray says "opaque", not how opaque: the spectral nodes are fitted up to it at most.
OPAQUE = 15.0


@dataclass
class _Known:
    """What is made once for a scan, whatever the physics that it is fitted under."""

    copies: dict[torch.device, torch.Tensor] = field(default_factory=dict)
    level: dict[torch.device, tuple[tuple[Scatter, float], torch.Tensor, float]] = field(default_factory=dict)
    closed: tuple[bool, str] | None = None
    agreement: list[float | None] | None = None
    noise: RayNoise | None = None
    solid: bool = False
    hardening: float | None = None
    taken: list[Step] = field(default_factory=list)


@dataclass(frozen=True, eq=False)
class Problem:
    """What is to be fitted.

    Parameters
    ----------
    projections : (views, rows, columns) float32 array, or HostRays
        -log(I/I0); NaN for rays that are not to be used.
    geometry, grid : Geometry, VolumeGrid
        In the solver's coordinates.
    centre : (3,) float64
        Origin of the solver's coordinates, in the caller's unit.
    length : float
        Their unit of length in the caller's.
    depth : float
        The same in cm; in the caller's unit for a monochromatic model. It makes a density in the solver's
        coordinates, areal density per unit of length, of one in g/cm3, or of an attenuation.
    planar : bool
        Two-dimensional: one row and one slice in one plane.
    spectrum, materials : Spectrum, Materials, or None
        None for a monochromatic model.
    scatter : Scatter
        That the rays hold besides what passes.
    beam : float
        Brightness of the beam, in those of the open field that the rays are relative to.
    margin : tuple of int
        Voxels that the grid has more than the volume that is asked for; see `fit.surroundings.Surroundings`.
    surroundings : str
        Why, if so.
    filter_map : FilterMap or None
        In front of the object, where it is not everywhere as thick; what was measured is relative to the open beam
        behind it.
    order : (views,) int array or None
        Which of the caller's views each one is; None where they are as the caller has them.
    given : tuple of float
        Values that opaque and saturated rays were given, which tell no noise.
    """

    projections: np.ndarray | HostRays
    geometry: Geometry
    grid: VolumeGrid
    centre: np.ndarray
    length: float
    depth: float
    planar: bool
    spectrum: Spectrum | None = None
    materials: Materials | None = None
    scatter: Scatter = Scatter()
    beam: float = 1.0
    margin: Margin = NO_MARGIN
    surroundings: str = ""
    order: np.ndarray | None = None
    filter_map: FilterMap | None = None
    given: tuple[float, ...] = ()
    _known: _Known = field(default_factory=_Known, init=False, repr=False)

    # What a caller of reconstruct tells, as it comes.
    @classmethod
    def of(
        cls,
        projections: np.ndarray,
        geometry: Geometry,
        grid: VolumeGrid,
        unit: str,
        spectrum: Spectrum | None,
        materials: Materials | Sequence[Any] | None,
        surroundings: float = 0.0,
        device: torch.device = _HOST,
        own: bool = False,
    ) -> Problem:
        """The problem of a scan in the caller's unit, its views sorted; one energy makes it monochromatic.

        The grid may be wider by as much as the share ``surroundings`` on every side, which a ``device`` finds out. The
        projections of a caller who gives them up (``own``) are sorted in place, and leave the host for a GPU with room.
        """
        require_choice("unit", unit, LENGTH_UNITS)
        if spectrum is not None and spectrum.is_monochromatic:
            spectrum = None
        curves = Materials.under(materials, None if spectrum is None else spectrum.effective_energy)
        around = surroundings_of(projections, geometry, grid, surroundings, device)
        grid = around.grid
        if around.missed.any():
            projections = projections if own else projections.copy()
            projections[around.missed] = np.nan
            own = True
        planar = geometry.planar and grid.planar
        # A plane beside the slice is another plane.
        planar = planar and bool(grid.lower[2] <= geometry.corner[0, 2] <= grid.upper[2])
        length = 0.5 * float(grid.extent[: 2 if planar else 3].max())
        depth = length if spectrum is None else length * cm_per(unit)
        inside = snapped_grid(grid.normalised(grid.centre, length))
        outside = snapped_geometry(geometry.normalised(grid.centre, length))
        order = view_order(outside, projections)
        mixed = bool((np.diff(order) != 1).any())
        if mixed and own:
            sorted_in_place(projections, order)
        elif mixed:
            projections = projections[order]
        outside = outside.select(order) if mixed else outside
        rays = HostRays(projections) if own and device.type == "cuda" else projections
        return cls(
            rays, outside, inside, grid.centre, length, depth, planar, spectrum, curves,
            margin=around.margin, surroundings=around.why, order=order if mixed else None,
        )  # fmt: skip

    @property
    def polychromatic(self) -> bool:
        """Whether energies differ."""
        return self.spectrum is not None

    @property
    def solid(self) -> bool:
        """Whether the start volume was made as that of an object of one solid."""
        return self._known.solid

    @property
    def hardening(self) -> float | None:
        """Of the hardening by a solid of its density, the share that an object of one solid shows, where it does."""
        return self._known.hardening

    def remember_solid(self, whether: bool, hardening: float | None = None) -> None:
        """Keep whether it is, and how it hardens the beam, for those who look at that volume."""
        self._known.solid, self._known.hardening = whether, hardening

    @property
    def dimensions(self) -> int:
        """In which Gaussians extend: 2 in a planar problem, else 3."""
        return 2 if self.planar else 3

    @property
    def axis(self) -> np.ndarray:
        """(3,) a point on the axis of rotation, in the solver's coordinates."""
        return -self.centre / self.length

    @property
    def voxel(self) -> float:
        """Shortest edge of a voxel, in the solver's coordinates."""
        return float(self.grid.voxel_size[: self.dimensions].min())

    def seen_by(self, geometry: Geometry, *, nearly: bool = False) -> Problem:
        """The same measurements by a scanner that stood elsewhere; copies of them on devices serve both.

        Where it is ``nearly`` the same, what lies beside the volume is not asked again.
        """
        other, known = replace(self, geometry=geometry), self._known
        closed = known.closed if nearly else None
        shared = _Known(known.copies, known.level, closed=closed, noise=known.noise, taken=known.taken)
        object.__setattr__(other, "_known", shared)
        return other

    def behind(self, filter_map: FilterMap | None) -> Problem:
        """The same measurements through another filter; copies of them on devices serve both."""
        other, known = replace(self, filter_map=filter_map), self._known
        shared = _Known(known.copies, closed=known.closed, agreement=known.agreement, taken=known.taken)
        object.__setattr__(other, "_known", shared)
        return other

    def told_geometry(self) -> Geometry:
        """The scanner in the caller's unit, its views in the caller's order."""
        geometry = self.geometry.scaled(self.length).shifted(self.centre)
        return geometry if self.order is None else geometry.select(np.argsort(self.order))

    def under(self, spectrum: Spectrum, scatter: Scatter, beam: float) -> Problem:
        """The same measurements under other physics; copies of them on devices serve both."""
        other = replace(self, spectrum=spectrum, scatter=scatter, beam=beam)
        object.__setattr__(other, "_known", self._known)
        return other

    def with_one_energy(self) -> Problem:
        """The same measurements as if all photons had one energy; copies of them on devices serve both."""
        other = replace(self, spectrum=None, materials=None, depth=self.length, scatter=Scatter(), beam=1.0)
        known = _Known(self._known.copies, closed=self._known.closed, noise=self._known.noise)
        object.__setattr__(other, "_known", known)
        return other

    def soft_attenuation(self) -> float:
        """Attenuation in 1/unit of a density of 1 at the volume's energy; 1 for a monochromatic model."""
        if self.spectrum is None or self.materials is None:
            return 1.0
        per_gram = self.materials.mass_attenuation([self.spectrum.effective_energy])[0, 0]
        return float(per_gram) * self.depth / self.length

    def measured(self, device: torch.device) -> torch.Tensor:
        """The projections on a device, copied there once; on the host where they do not fit there.

        They are relative to the beam, and scatter that varies is made level
        (`tomo_polysplat.physics.scatter.made_level`).
        """
        return self._level(device)[0]

    def scatter_level(self, device: torch.device) -> float:
        """The constant scatter of what was measured, as a fraction of the beam."""
        return self._level(device)[1]

    def _level(self, device: torch.device) -> tuple[torch.Tensor, float]:
        """What was measured, made level, and its scatter; of what differs from the copies the last one is kept."""
        values, light = self._copied(device), (self.scatter, self.beam)
        dimmed = self.dimmed(device)
        if not self.scatter.varies and self.beam == 1.0:
            return values, self.scatter.constant
        known = self._known.level.get(device)
        if known is None or known[0] != light:
            # Let go of first: there may be no room for both.
            known = None
            self._known.level.pop(device, None)
            # Those on the device: of the caller's array nothing was taken out.
            values = values if projections_stay(values.nbytes, device) else values.cpu()
            if dimmed is None:
                known = (light, *made_level(values, self.scatter, self.beam))
            else:
                # Scatter is relative to the beam in front of the filter.
                dimmed = dimmed.to(values.device)
                level, constant = made_level(values + dimmed, self.scatter, self.beam)
                known = (light, level.sub_(dimmed), constant)
            self._known.level[device] = known
        return known[1:]

    @property
    def taken(self) -> TakenOut:
        """Gains and drift that were taken out of what was measured."""
        known = self._known

        def copies() -> Iterator[torch.Tensor]:
            yield from known.copies.values()
            yield from (level[1] for level in known.level.values())

        return TakenOut(self.projections.shape, known.taken, copies)

    def forget_told(self) -> None:
        """Forget what rays told that have been changed since: their noise, where matter lies, what is texture."""
        known = self._known
        known.agreement = known.closed = None
        # Less gains and drift rays do not hold what they were given any more.
        known.noise = known.noise if self.given else None

    def let_go_of_level(self) -> None:
        """Forget rays made level for physics that is not used: they take as much memory as those measured."""
        self._known.level.clear()

    def _copied(self, device: torch.device) -> torch.Tensor:
        copies, rays = self._known.copies, self.projections
        if device not in copies:
            # An array that a caller keeps is shared, where it is not copied.
            rays = rays if isinstance(rays, HostRays) else HostRays(rays)
            copies[device] = rays.on(device)
        return copies[device]

    def agreement(self, bodies: Sequence[torch.Tensor]) -> list[float | None]:
        """How much of what varies in bodies of voxels is the object's, told once a scan; see ``start.agreement``."""
        if self._known.agreement is None:
            # Of a start that a GPU has no room for the bodies are on the host.
            device = next((one for one in self._known.copies if one.type == "cuda"), bodies[0].device)
            values = self._copied(device)
            try:
                self._known.agreement = halves_agree(values, self.geometry, self.grid, bodies, device)
            except RuntimeError as problem:
                # Torch's or ASTRA's, of a GPU that has no room for two more volumes.
                if device.type != "cuda":
                    raise
                logger.warning("Texture is not told from noise: %s", problem)
                self._known.agreement = [None] * len(bodies)
        return self._known.agreement

    def noise(self, device: torch.device) -> RayNoise:
        """How noisy the rays are, told once a scan; see ``scan.noise``."""
        if self._known.noise is None:
            told = self._copied(device), self.dimmed(device)
            self._known.noise = ray_noise(*told, given=self.given)
        return self._known.noise

    def correlation_of_noise(self, device: torch.device) -> float:
        """How the noise of neighbouring pixels correlates; see ``scan.noise``."""
        return correlation_of_noise(self._copied(device))

    def photons(self, device: torch.device) -> float:
        """Photons of an unattenuated ray, by that noise."""
        return self.noise(device).photons

    def closed(self, device: torch.device) -> tuple[bool, str]:
        """Whether no matter lies beside the volume, and words that say so."""
        if self._known.closed is None:
            closed, words = not self.surroundings, self.surroundings
            # Of matter beside the volume the log warns, also where what lies above and below is fitted.
            if not any(self.margin[2:]):
                inside, why = matter_is_inside(self._copied(device), self.geometry, self.grid)
                closed, words = closed and inside, words or why
            self._known.closed = closed, words
        return self._known.closed

    def dimmed(self, device: torch.device) -> torch.Tensor | None:
        """(rows, columns) -log of the share of the beam that passes each pixel's filter; None without filters."""
        if self.filter_map is None or self.spectrum is None:
            return None
        return torch.from_numpy(self.filter_map.dimmed(self.spectrum)).to(device)

    def primary(self, device: torch.device) -> torch.Tensor:
        """The projections as they would be without scatter and without pixels' filters, on a device."""
        values, level = self._level(device)
        dimmed = self.dimmed(values.device)
        if dimmed is None:
            return without_scatter(values, level, OPAQUE) if level else values
        assert self.filter_map is not None and self.spectrum is not None and self.materials is not None
        if level:
            values = without_scatter(values + dimmed, level, OPAQUE).sub_(dimmed)
        return self.filter_map.as_if_bare(values, self.spectrum, self.materials.soft)

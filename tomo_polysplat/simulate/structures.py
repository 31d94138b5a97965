"""Voxel phantoms with detail a few voxels wide everywhere, as real objects have it: bone, foam and grains."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch

from tomo_polysplat.checks import fail, require_choice, require_number

__all__ = ["EMPTY", "MATRIX", "METAL", "SOLID", "STRUCTURES", "Structure", "Substance"]

# Labels of voxels.
EMPTY, MATRIX, SOLID, METAL = 0, 1, 2, 3
# In half widths of the volume: radius and half height of the body, and the thickness of its shell.
_RADIUS, _HEIGHT, _SHELL = 0.8, 0.84, 0.06
# The screw, in half widths: its axis, half length, radius, and depth and pitch of its thread.
_AXIS, _LENGTH, _CORE, _THREAD, _PITCH = (0.22, -0.12, 1.0), 0.62, 0.14, 0.035, 0.1
# Points of the random field's lattice by its period, and its band as deviations of two blurs in periods.
_POINTS, _BAND = 6, (0.16, 0.26)


@dataclass(frozen=True)
class Substance:
    """What a label is made of: a material that ``physics.materials`` knows, and g/cm3; 0 for nothing."""

    material: str
    density: float


@dataclass(frozen=True)
class _Kind:
    """Substances of matrix, solid and metal, period of the structure in features, and whether it has a shell."""

    substances: tuple[Substance, Substance, Substance]
    period: float
    shell: bool


_TITANIUM, _IRON = Substance("titanium", 4.5), Substance("iron", 7.87)
STRUCTURES = {
    "bone": _Kind((Substance("water", 0.98), Substance("bone", 1.9), _TITANIUM), 2.0, True),
    "foam": _Kind((Substance("water", 0.0), Substance("aluminium", 2.7), _IRON), 4.0, True),
    "grains": _Kind((Substance("water", 1.0), Substance("SiO2", 2.65), _IRON), 3.0, False),
}


@dataclass(frozen=True, eq=False)
class Structure:
    """One object on a cubic grid of fine voxels, made slab by slab, each slab the same however it is cut.

    Parameters
    ----------
    kind : str
        One of ``STRUCTURES``: struts of bone in marrow with a shell, walls of an aluminium foam, grains of quartz in
        brine.
    fine : int
        Voxels along an edge.
    feature : float
        Width of the detail in fine voxels.
    metal : bool
        Whether a screw of titanium or steel is in it.
    seed : int
        Of the structure.
    device : torch.device
    """

    kind: str
    fine: int
    feature: float
    metal: bool = True
    seed: int = 0
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))

    def __post_init__(self) -> None:
        require_choice("kind", self.kind, STRUCTURES)
        require_number("feature", self.feature, at_least=2.0)
        if self.fine < 8:
            raise fail("size", "at least 4 voxels along an edge", f"{self.fine / 2:g}")

    @property
    def substances(self) -> tuple[Substance, ...]:
        """Of matrix, solid and metal."""
        return STRUCTURES[self.kind].substances

    def slabs(self) -> Callable[[int, int], torch.Tensor]:
        """A function from the first fine slice, and the one after the last, to labels (z, y, x), uint8."""
        period = STRUCTURES[self.kind].period * self.feature
        solid = self._grains(period) if self.kind == "grains" else self._of_field(period)

        def labels(first: int, last: int) -> torch.Tensor:
            z, y, x = self._places(first, last)
            radius = torch.sqrt(x**2 + y**2)
            body = (radius < _RADIUS) & (z.abs() < _HEIGHT)
            found = torch.where(solid(first, last), SOLID, MATRIX).to(torch.uint8)
            if STRUCTURES[self.kind].shell:
                found[((radius > _RADIUS - _SHELL) & body).expand(found.shape)] = SOLID
            found[(~body).expand(found.shape)] = EMPTY
            if self.metal:
                found[self._screw(z, y, x)] = METAL
            return found

        return labels

    def _places(self, first: int, last: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Coordinates from -1 to 1 of some slices, to be broadcast."""
        z = (torch.arange(first, last, device=self.device) + 0.5) / self.fine * 2 - 1
        across = (torch.arange(self.fine, device=self.device) + 0.5) / self.fine * 2 - 1
        return z[:, None, None], across[None, :, None], across[None, None, :]

    def _of_field(self, period: float) -> Callable[[int, int], torch.Tensor]:
        """Struts where a random field of that period, in fine voxels, is high; walls where it is near zero."""
        from scipy.ndimage import gaussian_filter

        step = period / _POINTS
        points = math.ceil(self.fine / step) + 2
        white = np.random.default_rng(self.seed).standard_normal((points,) * 3).astype(np.float32)
        narrow, wide = (gaussian_filter(white, _POINTS * blur, mode="wrap") for blur in _BAND)
        lattice = torch.from_numpy((narrow - wide) / (narrow - wide).std()).to(self.device)
        place = torch.arange(self.fine, device=self.device) / step
        # Of a normal field: 30 % struts, 20 % walls.
        level = 0.524 if self.kind == "bone" else 0.253

        def solid(first: int, last: int) -> torch.Tensor:
            value = lattice
            for axis, along in enumerate((place[first:last], place, place)):
                below = along.floor().long()
                share = (along - below).reshape([-1 if k == axis else 1 for k in range(3)])
                low, high = (value.index_select(axis, below + k) for k in (0, 1))
                value = low + share * (high - low)
            return value > level if self.kind == "bone" else value.abs() < level

        return solid

    def _grains(self, period: float) -> Callable[[int, int], torch.Tensor]:
        """Voronoi cells about that large around jittered points, and gaps of a third of a feature between them."""
        cells = math.ceil(self.fine / period) + 2
        drawn = np.random.default_rng(self.seed).random((cells, cells, cells, 3), np.float32)
        seeds = torch.from_numpy(drawn).to(self.device)
        along = torch.arange(self.fine, device=self.device) / period + 1

        def solid(first: int, last: int) -> torch.Tensor:
            out = torch.empty((last - first, self.fine, self.fine), dtype=torch.bool, device=self.device)
            for slice_, z in enumerate(along[first:last]):
                out[slice_] = self._slice_of_grains(seeds, z, along, period)
            return out

        return solid

    def _slice_of_grains(
        self, seeds: torch.Tensor, z: torch.Tensor, along: torch.Tensor, period: float
    ) -> torch.Tensor:
        near = torch.full((2, self.fine, self.fine), torch.inf, device=self.device)
        cell, most = along.floor().long(), len(seeds) - 1
        for dz, dy, dx in np.ndindex(3, 3, 3):
            at = [(part + step - 1).clamp(0, most) for part, step in ((z.long(), dz), (cell, dy), (cell, dx))]
            points = seeds[at[0]][at[1]][:, at[2]]
            away = (at[0] + points[..., 0] - z) ** 2
            away = away + (at[1][:, None] + points[..., 1] - along[:, None]) ** 2
            away = torch.sqrt(away + (at[2][None, :] + points[..., 2] - along[None, :]) ** 2)
            near[1] = torch.minimum(near[1], torch.maximum(near[0], away))
            near[0] = torch.minimum(near[0], away)
        return (near[1] - near[0]) * period > self.feature / 3

    def _screw(self, z: torch.Tensor, y: torch.Tensor, x: torch.Tensor) -> torch.Tensor:
        axis = np.array(_AXIS) / np.linalg.norm(_AXIS)
        along = x * axis[0] + y * axis[1] + z * axis[2]
        off = [part - along * towards for part, towards in zip((x, y, z), axis)]
        radius = torch.sqrt(off[0] ** 2 + off[1] ** 2 + off[2] ** 2)
        turn = torch.atan2(off[1], off[0]) / (2 * math.pi)
        # A triangular thread.
        thread = 2 * ((along / _PITCH - turn) % 1 - 0.5).abs()
        return (radius < _CORE + _THREAD * thread) & (along.abs() < _LENGTH)

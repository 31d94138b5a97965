"""What a reconstruction has found: data, which knows nothing of files, pages or pictures."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_number, require_shape
from tomo_polysplat.parallel import run_tasks, split_range
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.materials import require_energies
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.result.residuals import Residuals
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.units import cm_per

__all__ = ["GAUSSIAN_PARTS", "ResultData"]

# Voxels of a slab, and bytes of a part of it that one thread makes.
_AT_ONCE, _PART = 1 << 24, 1 << 22
GAUSSIAN_PARTS = {"position": (3,), "scale": (3,), "rotation": (4,), "density": (), "u": ()}


@dataclass(eq=False)
class ResultData:
    """The Gaussians of a reconstructed object, and the volumes sampled from them.

    :class:`~tomo_polysplat.Result` is this with what saves, draws and judges it, and tells of each field. Whatever
    takes a result as it is asks for this class, so that nothing which draws a result is imported by it.
    """

    basis: np.ndarray
    grid: VolumeGrid
    unit: str = "cm"
    energy_kev: float | None = None
    materials: Materials | None = None
    spectrum: Spectrum | None = None
    gaussians: Mapping[str, np.ndarray] = field(default_factory=dict)
    history: list[dict[str, Any]] = field(default_factory=list)
    plan: dict[str, Answer] = field(default_factory=dict)
    counts: dict[str, Any] = field(default_factory=dict)
    settings: dict[str, Any] = field(default_factory=dict)
    provenance: dict[str, Any] = field(default_factory=dict)
    geometry: dict[str, Any] | None = None
    gains: np.ndarray | None = None
    drift: np.ndarray | None = None
    seconds: float = 0.0
    flipped_2d: bool = False
    residuals: Residuals | None = None

    def __setattr__(self, name: str, value: Any) -> None:
        object.__setattr__(self, name, value)
        if name == "energy_kev":
            # It was made at another energy.
            self.__dict__.pop("volume", None)

    def __post_init__(self) -> None:
        self.basis = np.ascontiguousarray(require_array("basis", self.basis, 4), np.float32)
        channels = 1 if self.materials is None else 3
        require_shape("basis", self.basis, (channels, *self.grid.shape), "(channels, z, y, x)")
        if self.materials is not None and self.energy_kev is None:
            raise fail("energy_kev", "an energy in keV", "None", "a polychromatic result has one")
        if self.materials is not None:
            require_energies("energy_kev", self.energy_kev)
        if self.flipped_2d and self.grid.shape[0] != 1:
            raise fail("flipped_2d", "False for more than one slice", f"{self.grid.shape[0]} slices")
        if self.gaussians:
            self._check_gaussians()

    def _check_gaussians(self) -> None:
        number = len(require_array("gaussians['density']", self.gaussians["density"], ndim=1))
        for name, tail in GAUSSIAN_PARTS.items():
            require_shape(
                f"gaussians[{name!r}]", np.asarray(self.gaussians[name]), (number, *tail), "(n, ...)"
            )

    @property
    def is_monochromatic(self) -> bool:
        """Whether there is one attenuation volume and nothing to say about other energies."""
        return self.materials is None

    @cached_property
    def volume(self) -> np.ndarray:
        """Attenuation at :attr:`energy_kev` in 1/`unit`, float32, (z, y, x), or (y, x) after a 2D scan."""
        if self.materials is None:
            # A copy, as with a spectrum: what is done to it must not change what is saved.
            return self._public(self.basis[0].copy())
        return self._public(self._attenuation(self.energy_kev))

    def slabs(self) -> Iterator[tuple[slice, np.ndarray]]:
        """Slices, and :attr:`volume_zyx` there, one slab after another: all of it without all of it in memory."""
        depth = max(1, _AT_ONCE // max(math.prod(self.grid.shape[1:]), 1))
        for first in range(0, self.grid.shape[0], depth):
            some = slice(first, min(first + depth, self.grid.shape[0]))
            if "volume" in self.__dict__:
                yield some, self.volume_zyx[some]
            elif self.materials is None:
                yield some, self.basis[0, some]
            else:
                yield some, self._attenuation(self.energy_kev, some)

    @cached_property
    def coverage(self) -> np.ndarray:
        """Share of the views that see each voxel, float32 from 0 to 1, shaped like :attr:`volume`.

        What no ray sees, 0, is not measured, and is not air; told by 90 of the views and the voxels' centres.

        Raises
        ------
        ValueError
            For a result without its geometry.
        """
        from tomo_polysplat.scan.coverage import coverage
        from tomo_polysplat.scan.geometry import geometry_from_astra

        if self.geometry is None:
            raise fail("coverage", "a result with its geometry", "none", "reconstruct anew")
        return self._public(coverage(geometry_from_astra(self.geometry), self.grid))

    def attenuation(self, kev: float) -> np.ndarray:
        """Virtual monoenergetic volume: attenuation in 1/`unit`, float32, shaped like :attr:`volume`.

        Parameters
        ----------
        kev : float
            Photon energy in keV.

        Raises
        ------
        ValueError
            For an energy outside the tables, 0.1-800 keV, or another than a monochromatic result's.
        """
        kev = require_number("kev", kev, above=0)
        if self.materials is None:
            if self.energy_kev is None or abs(kev - self.energy_kev) > 1e-6 * kev:
                known = (
                    "its energy is unknown"
                    if self.energy_kev is None
                    else f"it knows {self.energy_kev:g} keV only"
                )
                raise fail(
                    "kev", "the energy of a monochromatic result", f"{kev:g}", f"{known}; pass a spectrum"
                )
            return self.volume.copy()
        require_energies("kev", [kev])
        return self._public(self._attenuation(kev))

    @cached_property
    def density(self) -> np.ndarray:
        """Density in g/cm3, shaped like :attr:`volume`: the sum of the three shares."""
        self._require_materials("density")
        return self._public(self.basis.sum(axis=0))

    @cached_property
    def material(self) -> np.ndarray:
        """Material map u from 0 (soft) over 1/2 (half of it middle) to 1 (dense), shaped like :attr:`volume`.

        ``u = (basis_middle / 2 + basis_dense) / density``, the mass-weighted mean u of the Gaussians
        at a voxel, exact for one material because ``2u(1-u) / 2 + u^2 = u``. 0 where there is next to
        nothing (below 1e-3 of the largest density).
        """
        self._require_materials("material")
        density = self.basis.sum(axis=0)
        dense_share = 0.5 * self.basis[1] + self.basis[2]
        present = density > 1e-3 * float(density.max())
        u = np.divide(dense_share, density, out=np.zeros_like(density), where=present)
        return self._public(np.clip(u, 0, 1, out=u))

    def _attenuation(self, kev: float | None, some: slice = slice(None)) -> np.ndarray:
        """(z, y, x) attenuation in some slices."""
        assert self.materials is not None and kev is not None
        curves = (self.materials.mass_attenuation([kev])[:, 0] * cm_per(self.unit)).astype(np.float32)
        first, behind, _ = some.indices(self.grid.shape[0])
        volume = np.empty((behind - first, *self.grid.shape[1:]), np.float32)

        def add_up(a: int, b: int) -> None:
            volume[a:b] = np.tensordot(curves, self.basis[:, first + a : first + b], axes=1)

        run_tasks(add_up, split_range(len(volume), volume.nbytes // _PART))
        return volume

    def _require_materials(self, name: str) -> None:
        if self.materials is None:
            raise fail(name, "a polychromatic result", "a monochromatic one", "reconstruct with a spectrum")

    @property
    def volume_zyx(self) -> np.ndarray:
        """The volume as (z, y, x) with y ascending, whatever order the caller's geometry has."""
        return self.volume[None, ::-1] if self.flipped_2d else self.volume

    def _public(self, volume: np.ndarray) -> np.ndarray:
        """In the order of the caller's geometry."""
        return np.ascontiguousarray(volume[0, ::-1]) if self.flipped_2d else volume

    def __repr__(self) -> str:
        energy = "unknown energy" if self.energy_kev is None else f"{self.energy_kev:.1f} keV"
        kind = "monochromatic" if self.materials is None else "polychromatic"
        number = len(self.gaussians.get("density", ()))
        return (
            f"Result({kind}, {self.grid.shape} voxels, 1/{self.unit} at {energy}, {number} Gaussians, "
            f"{self.seconds:.1f} s)"
        )

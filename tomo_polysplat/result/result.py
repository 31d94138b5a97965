"""What a reconstruction returns."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_number, require_shape
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.materials import require_energies
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.units import cm_per

if TYPE_CHECKING:
    from tomo_polysplat.quality.halves import Resolution
    from tomo_polysplat.quality.inserts import Contrast
    from tomo_polysplat.report.residuals import Residuals
    from tomo_polysplat.scan.scan import Scan

__all__ = ["Result"]

# Voxels of a slab.
_AT_ONCE = 1 << 24
GAUSSIAN_PARTS = {"position": (3,), "scale": (3,), "rotation": (4,), "density": (), "u": ()}


@dataclass(eq=False)
class Result:
    """A reconstructed object: its Gaussians, and the volumes sampled from them.

    Parameters
    ----------
    basis : float32 array, shape (3, z, y, x) or (1, z, y, x)
        Sums over the Gaussians of ``density [(1-u)^2, 2u(1-u), u^2]`` in g/cm3: how much of the soft,
        middle and dense curve each voxel holds. One channel of attenuation in 1/`unit` for a monochromatic
        result. y ascends with the index.
    grid : VolumeGrid
        Where the voxels are.
    unit : str
        Unit of length.
    energy_kev : float or None
        Energy of :attr:`volume`; None when a monochromatic scan did not state it.
    materials : Materials or None
        The three curves; None for a monochromatic result.
    spectrum : Spectrum or None
        The spectrum of the model.
    gaussians : mapping of arrays
        ``position`` (n, 3) and ``scale`` (n, 3) in `unit`, ``rotation`` (n, 4) unit quaternions (w, x, y, z),
        ``density`` (n,) in g/cm3 (1/`unit` when monochromatic), ``u`` (n,) material, -0.1 to 1.
    history : list of dict
        ``seconds``, ``iteration``, ``loss``, ``held_out``, ``gaussians``, ``stage``: speed against error.
    plan : dict of str to Answer
        What was decided and found, by name, with the value, why, where it comes from, and its evidence.
    counts, settings : dict
        How many rays or Gaussians were masked, skipped or clamped; every tunable.
    provenance : dict
        Words on what it was made from and with: scanner, volume, spectrum, device and software.
    geometry : dict, optional
        ASTRA's vector geometry of the projections, in `unit`: as told, or as ``align`` has found it.
    residuals : Residuals, optional
        How well the rays are explained, once :meth:`explain` or a report has looked at the scan; it is saved.
    gains : float32 array (rows, columns), optional
        Logarithm of each pixel's gain, less the sign: what was taken out of -log(I/I0); None where none was.
    drift : float32 array (views,), optional
        Likewise of each view's light.
    seconds : float
        Time that the reconstruction took.
    flipped_2d : bool
        Hand volumes out as ASTRA does in two dimensions: (y, x), row 0 at the largest y.
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
        curves = self.materials.mass_attenuation([kev])[:, 0] * cm_per(self.unit)
        return np.tensordot(curves.astype(np.float32), self.basis[:, some], axes=1)

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

    def save(
        self,
        path: str | os.PathLike,
        *,
        overwrite: bool = False,
        hu: bool = False,
        bits: int = 32,
        unseen_nan: bool = False,
    ) -> None:
        """Write to a file of the kind that the name's ending stands for.

        ``.h5`` and ``.hdf5`` hold everything, in the Data Exchange layout, and :meth:`load` reads them back. The
        others hold :attr:`volume` with voxel size and unit: ``.tif`` (ImageJ), ``.ome.tif``, a name ending in
        ``/`` (a folder of TIFF slices), ``.mha``, ``.nrrd``, ``.nii``, ``.nii.gz``, ``.vti`` (ParaView), ``.ome.zarr``,
        ``.dicom`` (a folder of DICOM slices, in Hounsfield units); ``.npy`` holds its numbers alone.
        Whatever fails or interrupts it, the old file stays as it was.

        Parameters
        ----------
        path : str or path
        overwrite : bool
            Whether an existing file, or folder of slices, is replaced.
        hu : bool
            Hounsfield units at :attr:`energy_kev` instead of attenuation: water is 0, nothing is -1000.
        bits : {32, 16}
            16 for whole numbers; the file says their slope and offset.
        unseen_nan : bool
            NaN for the voxels that no ray sees (:attr:`coverage`); not in ``.h5``, and not in 16 bits.

        Raises
        ------
        FileExistsError
            If the file exists and `overwrite` is false, or the folder holds anything but slices.
        OSError
            If the disk has too little free space, or the file could not be written.
        ValueError
            For another ending; for `hu` or `bits` where the file or the volume cannot have them.
        """
        from tomo_polysplat.result.formats import save_as

        save_as(self, path, overwrite=overwrite, hu=hu, bits=bits, unseen_nan=unseen_nan)

    @classmethod
    def load(cls, path: str | os.PathLike) -> Result:
        """Read what :meth:`save` wrote. Nothing is unpickled, and declared sizes are checked first.

        Of a large result (from 1 GiB) the densities and :attr:`volume` stay in the file, and are read where they are
        looked at; what is written to them does not change the file.

        Parameters
        ----------
        path : str or path

        Raises
        ------
        FileNotFoundError
        ValueError
            If the file is truncated, of another layout, or declares more than it holds.
        """
        from tomo_polysplat.result.files import load_hdf5

        return load_hdf5(path)

    def save_tiff(
        self, folder: str | os.PathLike, *, overwrite: bool = False, hu: bool = False, bits: int = 32
    ) -> None:
        """Write :attr:`volume` as TIFF slices ``slice_0000.tif``, ... to a folder that is there whole or not at all.

        The folder is new, or holds nothing but slices of before; parameters and errors are those of :meth:`save`.
        """
        from tomo_polysplat.result.image import image_of
        from tomo_polysplat.result.tiff import write_tiff_slices

        write_tiff_slices(image_of(self, hu=hu, bits=bits), folder, overwrite=overwrite)

    def save_npy(self, path: str | os.PathLike, *, overwrite: bool = False) -> None:
        """Write :attr:`volume` as a NumPy array file; parameters and errors are those of :meth:`save`."""
        from tomo_polysplat.result.files import write_npy
        from tomo_polysplat.result.image import image_of

        write_npy(image_of(self), path, overwrite=overwrite)

    def explain(self, scan: Scan, *, device: str = "auto") -> Residuals:
        """How well the rays are explained, by view and by pixel, in units of their noise; kept in `residuals`.

        Parameters
        ----------
        scan : Scan
            What this was made from.
        device : {"auto", "cpu", "cuda", "cuda:N"}

        Raises
        ------
        ValueError
            If the scan has another volume or unit, or this has no Gaussians.
        """
        from tomo_polysplat.report.residuals import residuals_of

        self.residuals = residuals_of(self, scan, device=device)
        return self.residuals

    # One parameter for each option that a caller names.
    def report(
        self,
        path: str | os.PathLike,
        *,
        scan: Scan | None = None,
        truth: np.ndarray | None = None,
        metal_mask: np.ndarray | None = None,
        resolution: Resolution | None = None,
        contrast: Contrast | None = None,
        overwrite: bool = False,
    ) -> None:
        """Write one self-contained HTML page for a colleague: a verdict, slices, residuals, decisions, the record.

        Parameters
        ----------
        path : str or path
        scan : Scan, optional
            What this was made from: the page then has FDK beside the result, and how well the rays are explained in
            units of their noise, by view and by pixel, unless `residuals` tell already. It takes the time of FDK and
            of one look at 180 views.
        truth, metal_mask : array shaped like :attr:`volume`, or None
            True attenuation in 1/`unit` at :attr:`energy_kev`, and voxels of metal, for figures of merit.
        resolution, contrast : Resolution, Contrast, optional
            What :func:`tomo_polysplat.resolution` and :func:`tomo_polysplat.contrast` have found of this result.
        overwrite : bool
            Whether an existing file is replaced.

        Raises
        ------
        FileExistsError
            If the file exists and `overwrite` is false.
        ValueError
            If truth or mask have another shape than the volume, or the scan another volume.
        """
        from tomo_polysplat.report.html import write_report

        found = (resolution, contrast)
        write_report(
            self, path, scan=scan, truth=truth, metal_mask=metal_mask, found=found, overwrite=overwrite
        )

    def show(
        self,
        others: Mapping[str, Any] | Result | np.ndarray | None = None,
        *,
        window: tuple[float, float] | None = None,
    ) -> Any:
        """Linked slices in a notebook, with sliders, one window for all volumes, a difference, and a scale bar.

        Parameters
        ----------
        others : Result, array or mapping of names to these, optional
            What is shown below this result, such as ``{"FDK": tps.baselines.fdk(scan)}``; shaped like :attr:`volume`.
        window : pair of float, optional
            Attenuation in 1/`unit` that is black, and white, to begin with.

        Returns
        -------
        ipywidgets.Widget
            Shown where it is the last line of a cell.

        Raises
        ------
        ImportError
            Without ipywidgets: ``pip install "tomo-polysplat[notebook]"``.
        ValueError
            For volumes of another shape.
        """
        from tomo_polysplat.report.show import show

        return show(self, others, window)

    def _repr_html_(self) -> str:
        from tomo_polysplat.report.show import snippet

        return snippet(self)

    def __repr__(self) -> str:
        energy = "unknown energy" if self.energy_kev is None else f"{self.energy_kev:.1f} keV"
        kind = "monochromatic" if self.materials is None else "polychromatic"
        number = len(self.gaussians.get("density", ()))
        return (
            f"Result({kind}, {self.grid.shape} voxels, 1/{self.unit} at {energy}, {number} Gaussians, "
            f"{self.seconds:.1f} s)"
        )

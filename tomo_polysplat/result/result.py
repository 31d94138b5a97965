"""What a reconstruction returns."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.result.data import ResultData
from tomo_polysplat.result.detail import Contrast, Resolution
from tomo_polysplat.result.residuals import Residuals

if TYPE_CHECKING:
    from tomo_polysplat.scan.scan import Scan

__all__ = ["Result"]


@dataclass(eq=False, repr=False)
class Result(ResultData):
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

        return load_hdf5(path, cls)

    def save_tiff(
        self, folder: str | os.PathLike, *, overwrite: bool = False, hu: bool = False, bits: int = 32
    ) -> None:
        """Write :attr:`volume` as TIFF slices ``slice_0000.tif``, ... to a folder that is there whole or not at all.

        The folder is new, or holds nothing but slices of before; parameters and errors are those of :meth:`save`.
        """
        from tomo_polysplat.result.image import image_of
        from tomo_polysplat.result.tiff import write_tiff_slices

        write_tiff_slices(image_of(self, hu=hu, bits=bits), folder, overwrite=overwrite)

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
        others: Mapping[str, Any] | ResultData | np.ndarray | None = None,
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

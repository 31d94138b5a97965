"""Kinds of files, by the ending of a name."""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tomo_polysplat.checks import did_you_mean, fail
from tomo_polysplat.result.image import image_bytes, image_of, require_bits

if TYPE_CHECKING:
    from tomo_polysplat.result.data import ResultData

__all__ = ["ENDINGS", "Format", "format_of", "save_as"]


@dataclass(frozen=True)
class Format:
    """A kind of file.

    Attributes
    ----------
    endings : tuple of str
        Endings of its names, in lower case.
    write : str
        Module and function that write it.
    sixteen_bits : bool
        Whether its header can hold slope and offset of whole numbers.
    everything : bool
        Whether it is the package's own, from which a result can be loaded.
    single_tiff : bool
        Whether it cannot be larger than 4 GiB.
    folder : str
        Module and function that refuse a folder which must stay, where it is a folder.
    hounsfield : bool
        Whether it always holds Hounsfield units, in 16 bits.
    """

    endings: tuple[str, ...]
    write: str
    sixteen_bits: bool = True
    everything: bool = False
    single_tiff: bool = False
    folder: str = ""
    hounsfield: bool = False

    def require_folder(self, folder: str | os.PathLike, **known: Any) -> Path:
        """The folder to write; refuses one that must stay, by `require_replaceable_folder`."""
        return _function(self.folder)(folder, **known)

    def bytes_needed(self, voxels: int, channels: int, bits: int = 32) -> int:
        """Bytes of a file with this many voxels and base curves."""
        bits = 16 if self.hounsfield else bits
        # Copies of an eighth, and an eighth of that, and so on.
        share = 8 / 7 if ".zarr" in self.endings else 1
        return int(share * image_bytes(voxels * (channels + 1 if self.everything else 1), bits))

    def require(self, *, hu: bool, bits: int, voxels: int = 0, argument: str = "path") -> None:
        """Refuse what this kind of file cannot hold."""
        from tomo_polysplat.result.tiff import require_tiff_size

        require_bits(bits)
        if self.everything and (hu or bits != 32):
            remedy = f"choose one of {', '.join(ENDINGS[2:])}"
            raise fail(argument, "a file of the volume alone for hu or bits", self.endings[0], remedy)
        if bits == 16 and not self.sixteen_bits:
            got = f"bits=16 for {self.endings[0]}"
            raise fail(argument, "a file that says slope and offset", got, "choose .tif, .nrrd or .nii.gz")
        if self.single_tiff:
            require_tiff_size(image_bytes(voxels, bits), argument)


FORMATS = (
    Format((".h5", ".hdf5"), "files.save_hdf5", everything=True),
    Format((".npy",), "files.write_npy", sixteen_bits=False),
    Format((".ome.tif", ".ome.tiff"), "tiff.write_ome_tiff"),
    Format((".tif", ".tiff"), "tiff.write_tiff", single_tiff=True),
    Format((".ome.zarr", ".zarr"), "ome_zarr.write_ome_zarr", folder="ome_zarr.require_zarr_folder"),
    Format((".dicom",), "dicom.write_dicom", folder="dicom.require_dicom_folder", hounsfield=True),
    Format(("/",), "tiff.write_tiff_slices", folder="tiff.require_slices_folder"),
    Format((".mha",), "image_files.write_metaimage"),
    Format((".nrrd",), "image_files.write_nrrd"),
    Format((".nii.gz", ".nii"), "image_files.write_nifti"),
    Format((".vti",), "image_files.write_vti"),
)
ENDINGS = tuple(ending for kind in FORMATS for ending in kind.endings)


def format_of(path: str | bytes | os.PathLike, argument: str = "path") -> Format:
    """The kind of file that a name stands for.

    Raises
    ------
    ValueError
        For another ending.
    """
    name = os.fsdecode(path).replace(os.sep, "/").lower()
    for kind in FORMATS:
        # A shell completes the name of a store that is there with a slash.
        if name.endswith(kind.endings) or (kind.folder and name.rstrip("/").endswith(kind.endings)):
            return kind
    remedy = did_you_mean(Path(name).suffix, ENDINGS)
    if name.endswith(".dcm"):
        remedy = "a DICOM series is a folder, of a name ending in .dicom"
    endings = ", ".join(ending for ending in ENDINGS if ending != "/")
    expected = f"a name ending in {endings}, or in / (a folder of TIFF slices)"
    raise fail(argument, expected, repr(os.fsdecode(path)), remedy)


def save_as(
    result: ResultData,
    path: str | os.PathLike,
    *,
    overwrite: bool = False,
    hu: bool = False,
    bits: int = 32,
    unseen_nan: bool = False,
) -> None:
    """See :meth:`Result.save`."""
    kind = format_of(path)
    kind.require(hu=hu, bits=bits, voxels=result.basis[0].size)
    if kind.everything and unseen_nan:
        remedy = "Result.load reads it back, whose coverage tells"
        raise fail("unseen_nan", "a file of the volume alone", os.fsdecode(path), remedy)
    if kind.hounsfield:
        if unseen_nan:
            raise fail("unseen_nan", "a file of floating point", os.fsdecode(path), "choose .nrrd or .nii.gz")
        # Rounded by its writer, once.
        hu, bits = True, 32
    content = result if kind.everything else image_of(result, hu=hu, bits=bits, unseen_nan=unseen_nan)
    _function(kind.write)(content, path, overwrite=overwrite)


def _function(name: str) -> Callable[..., Any]:
    from importlib import import_module

    module, function = name.split(".")
    return getattr(import_module(f"tomo_polysplat.result.{module}"), function)

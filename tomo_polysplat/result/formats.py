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
    from tomo_polysplat.result.result import Result

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
    """

    endings: tuple[str, ...]
    write: str
    sixteen_bits: bool = True
    everything: bool = False
    single_tiff: bool = False

    @property
    def is_folder(self) -> bool:
        """Whether it is a folder of slices."""
        return self.endings == ("/",)

    def bytes_needed(self, voxels: int, channels: int, bits: int = 32) -> int:
        """Bytes of a file with this many voxels and base curves."""
        return image_bytes(voxels * (channels + 1 if self.everything else 1), bits)

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
    Format(("/",), "tiff.write_tiff_slices"),
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
        if name.endswith(kind.endings):
            return kind
    remedy = did_you_mean(Path(name).suffix, ENDINGS)
    raise fail(argument, f"a name ending in {', '.join(ENDINGS)}", repr(os.fsdecode(path)), remedy)


def save_as(
    result: Result,
    path: str | os.PathLike,
    *,
    overwrite: bool = False,
    hu: bool = False,
    bits: int = 32,
    unseen_nan: bool = False,
) -> None:
    """See :meth:`Result.save`."""
    from importlib import import_module

    kind = format_of(path)
    kind.require(hu=hu, bits=bits, voxels=result.basis[0].size)
    module, name = kind.write.split(".")
    write: Callable[..., Any] = getattr(import_module(f"tomo_polysplat.result.{module}"), name)
    if kind.everything and unseen_nan:
        remedy = "Result.load reads it back, whose coverage tells"
        raise fail("unseen_nan", "a file of the volume alone", os.fsdecode(path), remedy)
    content = result if kind.everything else image_of(result, hu=hu, bits=bits, unseen_nan=unseen_nan)
    write(content, path, overwrite=overwrite)

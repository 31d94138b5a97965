"""Volumes for programs of ITK (3D Slicer, ITK-SNAP), for NIfTI and for ParaView: a header, and the numbers.

The numbers are written as plain bytes, slab by slab. So a full disk shows at once, and no second copy is needed.
"""

from __future__ import annotations

import gzip
import os
import struct
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import IO, Any
from xml.sax.saxutils import quoteattr

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import replacing
from tomo_polysplat.result.image import Image

__all__ = ["write_metaimage", "write_nifti", "write_nrrd", "write_vti"]

# NIfTI-1's numbers of types and units, from nifti1.h.
_NIFTI_TYPES = {np.dtype(np.float32): (16, 32), np.dtype(np.uint16): (512, 16)}
_MM, _LONGEST_AXIS = 2, 32767


def write_metaimage(image: Image, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """MetaImage, ``.mha``: header and numbers in one file (https://itk.org/Wiki/MetaIO/Documentation).

    Lengths are in mm. Slope and offset are its ``ElementToIntensityFunction``.
    """
    size, first = image.in_millimetres()
    kind = {"f": "MET_FLOAT", "u": "MET_USHORT"}[image.values.dtype.kind]
    lines = {
        "ObjectType": "Image",
        "NDims": 3,
        "Comment": image.about_text(),
        "BinaryData": True,
        "BinaryDataByteOrderMSB": False,
        "CompressedData": False,
        "TransformMatrix": "1 0 0 0 1 0 0 0 1",
        "Offset": _spaced(first),
        "CenterOfRotation": "0 0 0",
        "AnatomicalOrientation": "RAI",
        "ElementSpacing": _spaced(size),
        "DimSize": _spaced(image.values.shape[::-1]),
        "ElementToIntensityFunctionSlope": image.slope,
        "ElementToIntensityFunctionOffset": image.offset,
        "ElementType": kind,
        "ElementDataFile": "LOCAL",
    }
    header = "".join(f"{name} = {value}\n" for name, value in lines.items())
    with _new(path, image, overwrite) as file:
        file.write(header.encode("ascii"))
        _write_values(file, image.values)


def write_nrrd(image: Image, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """NRRD, ``.nrrd`` (https://teem.sourceforge.net/nrrd/format.html).

    Lengths are in mm. Slope, offset and unit stand as key and value.
    """
    size, first = image.in_millimetres()
    axes = [tuple(size[i] if i == axis else 0 for i in range(3)) for axis in range(3)]
    lines = [
        "NRRD0005",
        f"type: {image.values.dtype.name.replace('float32', 'float')}",
        "dimension: 3",
        "space: left-posterior-superior",
        f"sizes: {_spaced(image.values.shape[::-1])}",
        f"space directions: {' '.join(map(_vector, axes))}",
        "kinds: domain domain domain",
        'space units: "mm" "mm" "mm"' if image.unit != "pixel" else "",
        "endian: little",
        "encoding: raw",
        f"space origin: {_vector(first)}",
        *(f"{name}:={value}" for name, value in image.about().items()),
    ]
    header = "\n".join(filter(None, lines)) + "\n\n"
    with _new(path, image, overwrite) as file:
        file.write(header.encode("ascii"))
        _write_values(file, image.values)


def write_nifti(image: Image, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """NIfTI-1, ``.nii`` or ``.nii.gz`` (https://nifti.nimh.nih.gov/pub/dist/src/niftilib/nifti1.h).

    Lengths are in mm. NIfTI's x and y run to the right and to the front, ITK's to the left and to the back: both
    axes are turned, so that ITK's programs find a voxel where they find it in the other formats. Slope and offset
    are ``scl_slope`` and ``scl_inter``, which every reader applies.

    Raises
    ------
    ValueError
        For more than 32767 voxels along an axis.
    """
    if max(image.values.shape) > _LONGEST_AXIS:
        got = f"shape {image.values.shape}"
        raise fail("path", f"at most {_LONGEST_AXIS} voxels along an axis of NIfTI", got, "save as .nrrd")
    header = _nifti_header(image)
    with _new(path, image, overwrite) as file:
        if os.fsdecode(path).lower().endswith(".gz"):
            # Stronger compression of noise is slow and saves hardly anything; the same volume gives the same bytes.
            with gzip.GzipFile("", "wb", 1, file, mtime=0) as packed:
                packed.write(header)
                _write_values(packed, image.values)
        else:
            file.write(header)
            _write_values(file, image.values)


def _nifti_header(image: Image) -> bytes:
    size, first = image.in_millimetres()
    code, bits = _NIFTI_TYPES[image.values.dtype]
    units = _MM if image.unit != "pixel" else 0
    words = f"{image.quantity}" + (f" at {image.energy_kev:g} keV" if image.energy_kev is not None else "")
    rows = [[-size[0], 0, 0, -first[0]], [0, -size[1], 0, -first[1]], [0, 0, size[2], first[2]]]
    parts: list[tuple[str, Iterable[Any]]] = [
        ("i35xb", (348, 0)),
        ("8h", (3, *image.values.shape[::-1], 1, 1, 1, 1)),
        ("3f", (0, 0, 0)),
        ("4h", (0, code, bits, 0)),
        ("8f", (1, *size, 0, 0, 0, 0)),
        ("3f", (352, image.slope, image.offset)),
        ("hbb", (0, 0, units)),
        ("4f", (*reversed(image.window), 0, 0)),
        ("2i", (0, 0)),
        ("80s24s", (words.encode("ascii", "replace")[:79], b"")),
        # Both transforms: aligned to a scanner. A turn by 180 degrees about z is the quaternion (0, 0, 0, 1).
        ("2h", (1, 1)),
        ("6f", (0, 0, 1, -first[0], -first[1], first[2])),
        ("12f", [number for row in rows for number in row]),
        ("16s4s4x", (b"", b"n+1\0")),
    ]
    return b"".join(struct.pack("<" + layout, *values) for layout, values in parts)


def write_vti(image: Image, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """VTK image data, ``.vti``, for ParaView (https://docs.vtk.org/en/latest/vtk_file_formats/vtkxml_file_format.html).

    Lengths are in the scan's own unit; the numbers are point data at the centres of the voxels.
    """
    extent = _spaced(number for n in image.values.shape[::-1] for number in (0, n - 1))
    name = "HU" if image.quantity == "HU" else f"attenuation ({image.quantity})"
    kind = {"f": "Float32", "u": "UInt16"}[image.values.dtype.kind]
    fields = "".join(_vtk_field(key, value) for key, value in image.about().items())
    header = (
        '<?xml version="1.0"?>\n'
        '<VTKFile type="ImageData" version="1.0" byte_order="LittleEndian" header_type="UInt64">\n'
        f'<ImageData WholeExtent="{extent}" Origin="{_spaced(image.first)}" '
        f'Spacing="{_spaced(image.voxel_size)}" Direction="1 0 0 0 1 0 0 0 1">\n'
        f"<FieldData>\n{fields}</FieldData>\n"
        f'<Piece Extent="{extent}">\n<PointData Scalars={quoteattr(name)}>\n'
        f'<DataArray type="{kind}" Name={quoteattr(name)} format="appended" offset="0"/>\n'
        "</PointData>\n</Piece>\n</ImageData>\n"
        '<AppendedData encoding="raw">\n_'
    )
    with _new(path, image, overwrite) as file:
        file.write(header.encode("ascii") + struct.pack("<Q", image.values.nbytes))
        _write_values(file, image.values)
        file.write(b"\n</AppendedData>\n</VTKFile>\n")


def _vtk_field(name: str, value: Any) -> str:
    """One entry of the field data: numbers, or the character codes of a text."""
    if value is None:
        return ""
    if isinstance(value, str):
        numbers, kind, count = [*value.encode("ascii"), 0], "String", 'NumberOfTuples="1"'
    else:
        numbers = value if isinstance(value, list) else [value]
        kind, count = "Float64", f'NumberOfTuples="{len(numbers)}"'
    return f'<DataArray type="{kind}" Name="{name}" {count} format="ascii">{_spaced(numbers)}</DataArray>\n'


@contextmanager
def _new(path: str | os.PathLike, image: Image, overwrite: bool) -> Iterator[IO[bytes]]:
    with (
        replacing(path, overwrite=overwrite, needed_bytes=image.values.nbytes) as temporary,
        open(temporary, "wb") as file,
    ):
        yield file


def _write_values(file: IO[bytes] | gzip.GzipFile, values: np.ndarray) -> None:
    for plane in values:
        little = plane if sys.byteorder == "little" else plane.byteswap()
        file.write(np.ascontiguousarray(little).data)


def _spaced(numbers: Iterable[Any]) -> str:
    return " ".join(str(number) for number in numbers)


def _vector(numbers: Iterable[float]) -> str:
    return f"({','.join(str(number) for number in numbers)})"

"""Volumes as a series of DICOM's CT images, a folder with a file for each slice.

The attributes are those of the CT image (PS3.3, A.3). Whatever tells of a patient or a study
is there and empty, as the standard has it for what is not known; nothing is invented but identifiers, which are random.
"""

from __future__ import annotations

import os
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.folders import replacing_folder, require_replaceable_folder
from tomo_polysplat.plain_file import PlainFile
from tomo_polysplat.result.image import Image

if TYPE_CHECKING:
    from pydicom.dataset import Dataset

__all__ = ["require_dicom_folder", "write_dicom"]

_NAME = re.compile(r"slice_\d{4,}\.dcm")
_PROGRAM, _WHAT = "tomo-polysplat", "DICOM slices of ours"
_LEVELS, _LONGEST_SIDE = 65535, 65535
# What most programs take for granted where it suffices: whole Hounsfield units from here on.
_INTERCEPT = -1024.0
# Bytes of a file beside its numbers.
_HEADER = 4096
# Empty where nothing is known: attributes of type 2.
_UNKNOWN = (
    *("PatientName", "PatientID", "PatientBirthDate", "PatientSex", "StudyDate", "StudyTime", "StudyID"),
    *("AccessionNumber", "ReferringPhysicianName", "SeriesNumber", "PatientPosition", "Manufacturer"),
    *("PositionReferenceIndicator", "AcquisitionNumber", "KVP", "Laterality"),
)


def write_dicom(image: Image, path: str | os.PathLike, *, overwrite: bool = False) -> None:
    """A folder of ``slice_0001.dcm``, ... in Hounsfield units; it is written whole or not at all.

    x, y and z are taken for the patient's left, back and head. Numbers are whole Hounsfield units where the volume's
    range allows, and else 65536 steps of it.

    Raises
    ------
    ImportError
        Without pydicom: ``pip install "tomo-polysplat[dicom]"``.
    """
    pydicom = _pydicom()
    if max(image.values.shape[1:]) > _LONGEST_SIDE:
        got = f"{image.values.shape[1:]}"
        raise fail("path", f"at most {_LONGEST_SIDE} rows and columns of DICOM", got, "save as .nrrd")
    slope, intercept = _rescale(image.values)
    shared, uid = _shared(image, slope, intercept), pydicom.uid.generate_uid
    for name in ("StudyInstanceUID", "SeriesInstanceUID", "FrameOfReferenceUID"):
        setattr(shared, name, uid(prefix=None))
    needed = image.values.size * 2 + _HEADER * len(image.values)
    known = {"overwrite": overwrite, "what": _WHAT, "needed_bytes": needed}
    with replacing_folder(path, _is_ours, **known) as folder:  # type: ignore[arg-type]
        for index, plane in enumerate(image.values):
            numbers = np.clip(np.rint((plane.astype(np.float64) - intercept) / slope), 0, _LEVELS)
            one = _slice(image, shared, index, uid(prefix=None))
            one.PixelData = numbers.astype("<u2").tobytes()
            with PlainFile(folder / f"slice_{index + 1:04d}.dcm") as plain:
                one.save_as(plain, enforce_file_format=True)


def require_dicom_folder(folder: str | os.PathLike, **known: Any) -> Path:
    """The folder to write; refuse one that is, or holds, anything but our slices, and a missing pydicom."""
    _pydicom()
    return require_replaceable_folder(folder, _is_ours, what=_WHAT, **known)


def _pydicom() -> Any:
    try:
        import pydicom
    except ImportError as error:
        remedy = "python -m pip install 'tomo-polysplat[dicom]'"
        raise fail("path", "pydicom, which writes DICOM files", "none", remedy, ImportError) from error
    return pydicom


def _is_ours(path: Path) -> bool:
    """Whether a file is a slice of ours, by what it says of the program."""
    if not _NAME.fullmatch(path.name) or path.is_symlink() or not path.is_file():
        return False
    try:
        about = _pydicom().dcmread(path, specific_tags=["SoftwareVersions"], stop_before_pixels=True)
        return str(about.get("SoftwareVersions", "")).startswith(_PROGRAM)
    except Exception:  # a file of another program, or not DICOM at all
        return False


def _rescale(values: np.ndarray) -> tuple[float, float]:
    """Slope and intercept that stored numbers from 0 to 65535 span the values with."""
    low, high = float(values.min()), float(values.max())
    intercept = _INTERCEPT if low >= _INTERCEPT else float(np.floor(low))
    if high <= intercept + _LEVELS:
        return 1.0, intercept
    # Both have to fit into the sixteen characters of a decimal string.
    return float(f"{(high - intercept) / _LEVELS * (1 + 1e-9):.9g}"), intercept


def _shared(image: Image, slope: float, intercept: float) -> Dataset:
    """What all slices have in common."""
    from pydicom.dataset import Dataset
    from pydicom.uid import CTImageStorage

    size, _ = image.in_millimetres()
    low, high = image.window
    energy = "" if image.energy_kev is None else f" at {image.energy_kev:g} keV"
    shared = Dataset()
    for name in _UNKNOWN:
        setattr(shared, name, None)
    known = {
        "SpecificCharacterSet": "ISO_IR 192",
        "SOPClassUID": CTImageStorage,
        "Modality": "CT",
        "ImageType": ["ORIGINAL", "PRIMARY", "AXIAL"],
        "SoftwareVersions": _PROGRAM,
        "ImageComments": f"Hounsfield units{energy}",
        "ImageOrientationPatient": [1, 0, 0, 0, 1, 0],
        "PixelSpacing": [_decimal(size[1]), _decimal(size[0])],
        "SliceThickness": _decimal(size[2]),
        "SamplesPerPixel": 1,
        "PhotometricInterpretation": "MONOCHROME2",
        "Rows": image.values.shape[1],
        "Columns": image.values.shape[2],
        "BitsAllocated": 16,
        "BitsStored": 16,
        "HighBit": 15,
        "PixelRepresentation": 0,
        "RescaleIntercept": _decimal(intercept),
        "RescaleSlope": _decimal(slope),
        "RescaleType": "HU",
        "WindowCenter": _decimal(0.5 * (low + high)),
        "WindowWidth": _decimal(max(high - low, 1.0)),
    }
    for name, value in known.items():
        setattr(shared, name, value)
    return shared


def _slice(image: Image, shared: Dataset, index: int, uid: Any) -> Dataset:
    """A slice without its numbers."""
    from pydicom.dataset import Dataset, FileMetaDataset
    from pydicom.uid import ExplicitVRLittleEndian

    size, first = image.in_millimetres()
    height = first[2] + index * size[2]
    one = Dataset(shared)
    one.SOPInstanceUID, one.InstanceNumber = uid, index + 1
    one.ImagePositionPatient = [_decimal(first[0]), _decimal(first[1]), _decimal(height)]
    one.SliceLocation = _decimal(height)
    one.file_meta = FileMetaDataset()
    one.file_meta.MediaStorageSOPClassUID, one.file_meta.MediaStorageSOPInstanceUID = one.SOPClassUID, uid
    one.file_meta.TransferSyntaxUID = ExplicitVRLittleEndian
    return one


def _decimal(number: float) -> str:
    """A number in the sixteen characters that DICOM has for it."""
    for digits in range(15, 0, -1):
        if len(text := f"{float(number):.{digits}g}") <= 16:
            return text
    raise fail("path", "lengths that DICOM can hold", f"{number!r}")

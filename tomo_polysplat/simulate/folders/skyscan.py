"""A folder as a SkyScan of Bruker's writes it: pictures that are corrected already, and a log."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tomo_polysplat.simulate.folders.scene import SETTINGS, Pictures
from tomo_polysplat.simulate.folders.tiffs import write_pictures

__all__ = ["write"]

# Counts of the open beam in corrected pictures.
REFERENCE = 57000


def write(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder; the object turns counterclockwise, so that the views come in the other order."""
    light = (pictures.flats - pictures.darks.astype(np.float64)).mean(axis=0)
    passed = (pictures.projections - pictures.darks[0].astype(np.float64)) / light
    corrected = np.clip(np.rint(REFERENCE * passed), 0, 65535).astype(np.uint16)
    order = -np.arange(len(corrected)) % len(corrected)
    write_pictures(folder, "marker_", corrected[order][:, :, ::-1])
    # The picture of the whole height that is taken before, of another size.
    write_pictures(folder, "marker_spr", np.zeros((1, 5, 7), np.uint16), digits=1)
    text = log_text(pictures)
    (folder / "marker_.log").write_bytes(text.replace("\n", "\r\n").encode("utf-8"))


def log_text(pictures: Pictures) -> str:
    """What such a scanner's log says."""
    at, (views, rows, columns) = SETTINGS, pictures.projections.shape
    return f"""[System]
Scanner=SkyScan1275
Instrument S/N=00A00000
Software=Version 1. 0 (build 1)
Camera Pixel Size (um)={1000 * at.pixel:.1f}
Camera X/Y Ratio=1.0000
[Acquisition]
Filename Prefix=marker_
Filename Index Length=4
Number Of Files=  {views}
Number Of Rows=  {rows}
Number Of Columns=  {columns}
Camera binning=1x1
Image Rotation=0.00000
Optical Axis (line)=  {(rows - 1) // 2}
Object to Source (mm)={at.source_object:.3f}
Camera to Source (mm)={at.source_detector:.3f}
Source Voltage (kV)=  {at.kvp:.0f}
Source Current (uA)= 124
Image Pixel Size (um)={1000 * at.pixel * at.source_object / at.source_detector:.6f}
Image Format=TIFF
Depth (bits)=16
Reference Intensity={REFERENCE}
Exposure (ms)=57
Rotation Step (deg)={360 / views:.3f}
Use 360 Rotation=YES
Flat Field Correction=ON
Filter=Al {at.filter_mm:.1f}mm
Rotation Direction=CC
Type of Detector Motion=STEP AND SHOOT
Study Date and Time=25 Nov 2026  14h:52m:29s
[Reconstruction]
Postalignment={-at.columns_off:.2f}
"""

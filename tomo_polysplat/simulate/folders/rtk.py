"""A folder with a geometry of RTK's and the projections in a MetaImage, as line integrals."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tomo_polysplat.simulate.folders.scene import SETTINGS, Pictures

__all__ = ["write"]


def write(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder; the first row is the lowest."""
    light = (pictures.flats - pictures.darks.astype(np.float64)).mean(axis=0)
    passed = np.maximum(pictures.projections - pictures.darks[0].astype(np.float64), 0.5) / light
    lines = -np.log(passed)[:, ::-1].astype("<f4")
    at, (views, rows, columns) = SETTINGS, lines.shape
    origin = [-0.5 * (columns - 1) * at.pixel, -0.5 * (rows - 1) * at.pixel, 0]
    header = f"""ObjectType = Image
NDims = 3
BinaryData = True
BinaryDataByteOrderMSB = False
CompressedData = False
TransformMatrix = 1 0 0 0 1 0 0 0 1
Offset = {" ".join(map(str, origin))}
ElementSpacing = {at.pixel} {at.pixel} 1
DimSize = {columns} {rows} {views}
ElementType = MET_FLOAT
ElementDataFile = LOCAL
"""
    (folder / "projections.mha").write_bytes(header.encode("ascii") + lines.tobytes())
    turns = "\n".join(
        f"  <Projection>\n    <GantryAngle>{angle}</GantryAngle>\n  </Projection>"
        for angle in pictures.degrees
    )
    (folder / "geometry.xml").write_text(
        f"""<?xml version="1.0"?>
<!DOCTYPE RTKGEOMETRY>
<RTKThreeDCircularGeometry version="3">
  <SourceToIsocenterDistance>{at.source_object}</SourceToIsocenterDistance>
  <SourceToDetectorDistance>{at.source_detector}</SourceToDetectorDistance>
  <ProjectionOffsetX>{at.pixel * at.columns_off}</ProjectionOffsetX>
{turns}
</RTKThreeDCircularGeometry>
""",
        encoding="utf-8",
    )

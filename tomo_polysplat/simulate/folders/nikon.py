"""A folder as a scanner of Nikon's writes it: an .xtekct file, corrected TIFFs of one white level, and the angles."""

from __future__ import annotations

from pathlib import Path

from tomo_polysplat.simulate.folders.scene import SETTINGS, Pictures, corrected
from tomo_polysplat.simulate.folders.tiffs import write_pictures

__all__ = ["ASIDE", "write"]

WHITE = 60000
# By which the turntable is off the line from the source to the detector's middle, in mm.
ASIDE = 0.9


def write(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder."""
    write_pictures(folder, "marker_", corrected(pictures, WHITE)[:, :, ::-1], first=1)
    lines = [f"{k + 1}\t{angle:.4f}\t{k * 1.5:.3f}" for k, angle in enumerate(pictures.degrees)]
    header = ["Frames per projection: 1", "", "Projection\tAngle(deg)\tTime(s)"]
    (folder / "_ctdata.txt").write_text("\n".join([*header, *lines]), encoding="utf-8")
    at, (views, rows, columns) = SETTINGS, pictures.projections.shape
    voxel = at.pixel * at.source_object / at.source_detector
    (folder / "marker.xtekct").write_text(
        f"""[XTekCT]
Name=marker
InputSeparator=_
InputFolderName=
VoxelsX={columns}
VoxelSizeX={voxel}
SrcToObject={at.source_object}
SrcToDetector={at.source_detector}
DetectorPixelsX={columns}
DetectorPixelSizeX={at.pixel}
DetectorOffsetX=0
DetectorPixelsY={rows}
DetectorPixelSizeY={at.pixel}
DetectorOffsetY=0
CentreOfRotationTop=0.0
CentreOfRotationBottom=0.0
ObjectOffsetX={ASIDE}
ObjectRoll=0
ObjectTilt=0
WhiteLevel={WHITE}.0
Units=mm
Projections={views}
InitialAngle=0.0
AngularStep={360 / views}
[Xrays]
XraykV={at.kvp:.0f}
XrayuA=100
[CTPro]
Filter_ThicknessMM={at.filter_mm:.3f}
Filter_Material=Aluminium
""",
        encoding="utf-8",
    )

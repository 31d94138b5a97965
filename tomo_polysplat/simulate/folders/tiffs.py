"""A plain folder: TIFFs of the projections, flats and darks, and a small TOML file with the distances."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tomo_polysplat.simulate.folders.scene import SETTINGS, Pictures

__all__ = ["write", "write_distances", "write_pictures"]


def write(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder."""
    write_pictures(folder, "proj_", pictures.projections)
    write_pictures(folder, "flat_", pictures.flats)
    write_pictures(folder, "dark_", pictures.darks)
    write_distances(folder)


def write_distances(folder: Path) -> None:
    """The TOML file that stands beside pictures that tell nothing."""
    at = SETTINGS
    (folder / "scan.toml").write_text(
        f"""# Lengths are in mm.
source_object = {at.source_object}
source_detector = {at.source_detector}
pixel = {at.pixel}
offset = [{at.pixel * at.columns_off}, 0.0]
arc = 360
kvp = {at.kvp}
filter = "Al {at.filter_mm}mm"
operator = "nobody"
""",
        encoding="utf-8",
    )


def write_pictures(folder: Path, prefix: str, pictures: np.ndarray, digits: int = 4, first: int = 0) -> None:
    """One TIFF for each of the pictures, numbered from `first` on."""
    import tifffile

    for index, picture in enumerate(pictures, first):
        tifffile.imwrite(folder / f"{prefix}{index:0{digits}d}.tif", picture)

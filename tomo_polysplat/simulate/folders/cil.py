"""A folder with a NeXus file as the Core Imaging Library writes it: line integrals, the axis not at the origin."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tomo_polysplat.simulate.folders.scene import SETTINGS, Pictures

__all__ = ["write"]

# Where the rotation axis is in the file's frame, in mm.
_AXIS = np.array([3.0, -2.0, 1.0])


def write(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder; the first row is the top one, and the axes come as ASTRA's do."""
    import h5py

    at = SETTINGS
    light = (pictures.flats - pictures.darks.astype(np.float64)).mean(axis=0)
    passed = np.maximum(pictures.projections - pictures.darks[0].astype(np.float64), 0.5) / light
    behind = at.source_detector - at.source_object
    with h5py.File(folder / "marker.nxs", "w") as file:
        entry = file.create_group("entry1/tomo_entry")
        entry.attrs["NX_class"] = "NXentry"
        entry["data/data"] = -np.log(passed).transpose(1, 0, 2).astype(np.float32)
        about = {"dim0": "vertical", "dim1": "angle", "dim2": "horizontal", "panel_origin": "top-left"}
        about |= {"data_type": "AcquisitionData", "geometry": "cone", "dimension": "3D"}
        for name, text in about.items():
            entry["data/data"].attrs[name] = text
        for name in ("pixel_size_h", "pixel_size_v"):
            entry["data/data"].attrs[name] = at.pixel
        vectors = {
            "source/position": _AXIS + [0.0, -at.source_object, 0.0],
            "detector/position": _AXIS + [at.pixel * at.columns_off, behind, 0.0],
            "detector/direction_x": np.array([1.0, 0.0, 0.0]),
            "detector/direction_y": np.array([0.0, 0.0, 1.0]),
            "rotation_axis/position": _AXIS,
            "rotation_axis/direction": np.array([0.0, 0.0, 1.0]),
        }
        for name, vector in vectors.items():
            entry[f"config/{name}"] = vector.astype(np.float32)
        # Counted from another zero, and in the other sense than ours.
        entry["config/angles"] = (20.0 - pictures.degrees).astype(np.float32)
        entry["config/angles"].attrs["angle_unit"], entry["config/angles"].attrs["initial_angle"] = (
            "degree",
            -20.0,
        )

"""A folder with an NXtomo file in it: darks, flats, projections and a picture that is not to be used."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tomo_polysplat.simulate.folders.scene import SETTINGS, Pictures

__all__ = ["write"]


def write(folder: Path, pictures: Pictures) -> None:
    """Fill an empty folder; lengths are in m, as NeXus has them."""
    import h5py

    at = SETTINGS
    spoilt = np.zeros((1, *pictures.projections.shape[1:]), np.uint16)
    stacks = {2: pictures.darks, 1: pictures.flats, 0: pictures.projections, 3: spoilt}
    angles = {2: np.zeros(3), 1: np.zeros(3), 0: pictures.degrees, 3: np.zeros(1)}
    with h5py.File(folder / "marker.nx", "w") as file:
        entry = file.create_group("entry0000")
        entry.attrs["NX_class"] = "NXentry"
        entry["definition"], entry["title"], entry["sample/name"] = "NXtomo", "a marker", "marker"
        detector = entry.create_group("instrument/detector")
        detector["data"] = np.concatenate(list(stacks.values()))
        detector["image_key"] = np.concatenate([np.full(len(stack), key) for key, stack in stacks.items()])
        entry["sample/rotation_angle"] = np.concatenate(list(angles.values()))
        entry["sample/rotation_angle"].attrs["units"] = "degree"
        lengths = {
            "instrument/detector/x_pixel_size": at.pixel,
            "instrument/detector/y_pixel_size": at.pixel,
            "instrument/detector/distance": at.source_detector - at.source_object,
            "instrument/source/distance": -at.source_object,
        }
        for name, length in lengths.items():
            entry[name] = 1e-3 * length
            entry[name].attrs["units"] = "m"
        # From the detector's middle, in columns.
        detector["x_rotation_axis_pixel_position"] = -at.columns_off
        detector["count_time"] = np.full(len(detector["data"]), 0.1)

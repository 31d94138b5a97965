"""Scans into Data Exchange HDF5 files; `data_exchange` describes what stands where."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tomo_polysplat.scan.filter_map_file import write_filter_map
from tomo_polysplat.scan.hdf5 import write_spectrum
from tomo_polysplat.scan.hdf5_writer import new_hdf5
from tomo_polysplat.scan.layout import vector_form, window_of
from tomo_polysplat.scan.scan import Scan

if TYPE_CHECKING:
    import h5py

__all__ = ["write_hdf5"]


def write_hdf5(scan: Scan, path: str | Path, *, overwrite: bool = False) -> None:
    """Write a scan as Data Exchange with a group ``/polysplat`` of our own."""
    needed = sum(
        a.nbytes for a in (scan.projections, scan.truth, scan.metal_mask, scan.valid) if a is not None
    )
    with new_hdf5(path, overwrite=overwrite, needed_bytes=needed) as file:
        file["exchange/data"] = scan.projections.transpose(1, 0, 2)
        _describe(file, scan)


def _describe(file: h5py.File, scan: Scan) -> None:
    """Add to a file that holds the projections what else there is to know."""
    file["implements"] = "exchange:measurement:polysplat"
    file["measurement/sample/name"] = scan.name
    description = {"description": "attenuation", "axes": "theta:y:x", "units": "1"}
    file["exchange/data"].attrs.update(input="attenuation", **description)
    geometry = vector_form(scan.proj_geom)
    theta = file.create_dataset("exchange/theta", data=_theta_degrees(geometry["Vectors"]))
    theta.attrs["units"] = "degrees"
    group = file.create_group("polysplat/geometry")
    group.attrs.update(astra_type=geometry["type"], unit=scan.unit)
    group["vectors"] = geometry["Vectors"]
    group["volume_shape"], group["volume_window"] = np.array(scan.volume_shape), window_of(scan.vol_geom)
    _write_knowledge(file["polysplat"], scan)
    if "scanner" in scan.notes:
        file["polysplat/scanner"] = json.dumps(scan.notes["scanner"])


def _write_knowledge(group: h5py.Group, scan: Scan) -> None:
    write_spectrum(group, scan.spectrum)
    if scan.valid is not None:
        group["valid"] = scan.valid.transpose(1, 0, 2)
    if scan.water_correction is not None:
        group["water_correction"] = np.array(scan.water_correction)
    write_filter_map(group, scan)
    if scan.metal_mask is not None:
        group["metal_mask"] = scan.metal_mask
    if scan.truth is not None:
        group["truth"] = scan.truth
        group["truth"].attrs["unit"] = f"1/{scan.unit}"
        if scan.truth_energy_kev is not None:
            group["truth"].attrs["energy_kev"] = scan.truth_energy_kev


def _theta_degrees(vectors: np.ndarray) -> np.ndarray:
    """Azimuth of the source (or of a parallel beam's direction) as ASTRA counts angles: 0 is at -y."""
    return np.rad2deg(np.unwrap(np.arctan2(vectors[:, 0], -vectors[:, 1])))

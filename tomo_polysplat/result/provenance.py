"""Texts on what a result was made from and with, for its report and its file."""

from __future__ import annotations

import functools
from collections.abc import Iterable

import numpy as np
import torch

import tomo_polysplat
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid
from tomo_polysplat.versions import installed_version

__all__ = ["provenance"]

# Packages whose version may change a volume.
_PACKAGES = ("torch", "numba", "triton", "astra-toolbox")


def provenance(
    geometry: Geometry, grid: VolumeGrid, unit: str, spectrum: Spectrum | None, device: torch.device
) -> dict[str, str]:
    """Texts by name: ``geometry``, ``volume``, ``spectrum``, ``device`` and ``software``.

    Parameters
    ----------
    geometry : Geometry
    grid : VolumeGrid
    unit : str
        Unit of their lengths.
    spectrum : Spectrum or None
    device : torch.device
    """
    return {
        "geometry": _scanner(geometry, grid, unit),
        "volume": f"{_by(grid.shape[::-1])} voxels of {_lengths(grid.voxel_size, unit)} (x, y, z)",
        "spectrum": "none: one energy" if spectrum is None else spectrum.describe(),
        "device": torch.cuda.get_device_name(device) if device.type == "cuda" else "CPU",
        "software": ", ".join([f"tomo-polysplat {tomo_polysplat.__version__}", *_versions()]),
    }


def _scanner(geometry: Geometry, grid: VolumeGrid, unit: str) -> str:
    pixel = [float(np.median(np.linalg.norm(step, axis=1))) for step in (geometry.u, geometry.v)]
    words = f"{geometry.beam} beam, {geometry.views} views of {_by([geometry.columns, geometry.rows])} pixels"
    words += f" of {_lengths(pixel, unit)} (columns, rows)"
    if geometry.beam == "cone":
        source = np.median(np.linalg.norm(geometry.origin - grid.centre, axis=1))
        words += f", the source {source:.4g} {unit} from the middle of the volume"
    return words


def _by(sizes: Iterable[int]) -> str:
    return " x ".join(str(size) for size in sizes)


def _lengths(lengths: Iterable[float], unit: str) -> str:
    return " x ".join(f"{length:.4g}" for length in lengths) + f" {unit}"


@functools.cache
def _versions() -> list[str]:
    found = ((name, installed_version(name)) for name in _PACKAGES)
    return [f"{name} {version}" for name, version in found if version]

"""Scans of voxel phantoms of twice the resolution, through ASTRA's projector where there is a GPU."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from tomo_polysplat.checks import require_number
from tomo_polysplat.parallel import run_tasks
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.quadrature import Quadrature
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.transmission import polychromatic_projection
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, from_astra
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.orbit import circular_orbit
from tomo_polysplat.simulate.scanner import Scanner
from tomo_polysplat.simulate.structures import METAL, Structure
from tomo_polysplat.start.voxel_projector import projector_pair

__all__ = ["scan_structure"]

# Fine voxels along an edge of a voxel.
_FINE = 2
# Half the edge of the volume in cm: a sample that 70 kV pass, the tube behind so much aluminium in cm.
_HALF_WIDTH, _KVP, _ALUMINIUM = 0.6, 70.0, 0.05
# Fine voxels of a slab, and rays of some views, that a GPU holds at once, of every substance.
_SLAB, _RAYS = 1 << 29, 1 << 27


# One parameter for each option that a caller names.
def scan_structure(
    kind: str,
    size: int,
    views: int | None = None,
    *,
    columns: int | None = None,
    feature: float = 6.0,
    metal: bool = True,
    photons: float = 5e4,
    spectrum: Spectrum | None = None,
    seed: int = 0,
    device: str = "cpu",
) -> Scan:
    """Scan a structure on a circular cone-beam orbit.

    Parameters
    ----------
    kind : {"bone", "foam", "grains"}
    size : int
        Voxels along an edge of the volume.
    views, columns : int, optional
        Projection images, and pixels along an edge of the detector; 1.5 ``size`` each.
    feature : float
        Width of the detail in voxels.
    metal : bool
        Whether a screw is in it.
    photons : float
        Counts of a free ray.
    spectrum : Spectrum, optional
        That of a tungsten tube of 70 kV behind 0.5 mm of aluminium unless told.
    seed : int
        Of the object and of the noise.
    device : str
        Where it is made: with "cuda" ASTRA projects.

    Returns
    -------
    Scan
        In cm, with the truth at the spectrum's effective energy and the voxels that hold any metal.
    """
    size = int(require_number("size", size, at_least=4))
    views, columns = (round(1.5 * size) if n is None else int(n) for n in (views, columns))
    on = torch.device(device)
    structure = Structure(kind, _FINE * size, _FINE * feature, metal, seed, on)
    angles = 2 * math.pi * np.arange(views) / views
    proj_geom, vol_geom = circular_orbit("cone", _HALF_WIDTH, size, columns, columns, angles)
    geometry, grid = from_astra(proj_geom, vol_geom)
    if spectrum is None:
        spectrum = Spectrum.from_tube(_KVP, filters={"Al": _ALUMINIUM})
    labels = _labels(structure)
    projections, valid = _measured(structure, labels, geometry, grid, spectrum, Scanner(photons, seed=seed))
    truth, mask = _truth(structure, labels, float(spectrum.effective_energy))
    starved = int(valid.size - np.count_nonzero(valid))
    return Scan(
        projections=projections,
        proj_geom=proj_geom,
        vol_geom=vol_geom,
        spectrum=spectrum,
        truth=truth,
        metal_mask=mask,
        truth_energy_kev=float(spectrum.effective_energy),
        name=f"{kind}-{size}" if metal else f"{kind}-{size}-control",
        valid=None if starved == 0 else valid,
        notes={"starved_rays": starved, "photons": photons, "seed": seed, "feature": feature},
    )


def _slices(structure: Structure) -> list[tuple[int, int]]:
    """Fine slices of each slab, an even number; on a CPU one slab, which its projector does not cut."""
    fine, most = structure.fine, structure.fine
    if structure.device.type == "cuda":
        most = max(_FINE, _SLAB // fine**2 // _FINE * _FINE)
    return [(first, min(first + most, fine)) for first in range(0, fine, most)]


def _labels(structure: Structure) -> np.ndarray:
    """(z, y, x) uint8 on the host."""
    labels, make = np.empty((structure.fine,) * 3, np.uint8), structure.slabs()
    for first, last in _slices(structure):
        labels[first:last] = make(first, last).cpu().numpy()
    return labels


def _measured(
    structure: Structure,
    labels: np.ndarray,
    geometry: Geometry,
    grid: VolumeGrid,
    spectrum: Spectrum,
    scanner: Scanner,
) -> tuple[np.ndarray, np.ndarray]:
    """Projections (rows, views, columns) and their validity."""
    shape = (geometry.rows, geometry.views, geometry.columns)
    projections, valid = np.empty(shape, np.float32), np.empty(shape, bool)
    nodes = _nodes(structure, spectrum)
    many = max(1, _RAYS // (geometry.rows * geometry.columns * len(structure.substances)))

    def read_out(view: int, passed: np.ndarray) -> None:
        projections[:, view], valid[:, view] = scanner.projection(scanner.counts(passed, view))

    for first in range(0, geometry.views, many):
        some = np.arange(first, min(first + many, geometry.views))
        areal = _areal_densities(structure, labels, geometry, grid, some)
        passed = torch.exp(-polychromatic_projection(areal, nodes)).cpu().numpy().astype(np.float64)
        run_tasks(read_out, [(int(view), passed[k]) for k, view in enumerate(some)])
    return projections, valid


def _nodes(structure: Structure, spectrum: Spectrum) -> Quadrature:
    """All energies of a spectrum as nodes."""
    lit = spectrum.weights > 0
    weights = spectrum.weights[lit] / spectrum.weights[lit].sum()
    curves = [mass_attenuation(one.material, spectrum.energies[lit]) for one in structure.substances]
    return Quadrature(np.log(weights), np.stack(curves), 0.0, 0.0, 0.0, math.inf)


def _areal_densities(
    structure: Structure, labels: np.ndarray, geometry: Geometry, grid: VolumeGrid, views: np.ndarray
) -> torch.Tensor:
    """(substances, views, rows, columns) in g/cm2, slab by slab."""
    device, fine = structure.device, structure.fine
    edge = float(grid.extent[2]) / fine
    total = torch.zeros(
        (len(structure.substances), len(views), geometry.rows, geometry.columns), device=device
    )
    for first, last in _slices(structure):
        lower, upper = grid.lower.copy(), grid.upper.copy()
        lower[2], upper[2] = grid.lower[2] + first * edge, grid.lower[2] + last * edge
        slab = VolumeGrid((last - first, fine, fine), lower, upper)
        part = torch.from_numpy(labels[first:last]).to(device)
        with projector_pair(geometry, slab, device) as pair:
            for k, one in enumerate(structure.substances):
                if one.density > 0:
                    inside = (part == k + 1).to(torch.float32)
                    total[k] += one.density * pair.forward(inside, views)
    return total


def _truth(structure: Structure, labels: np.ndarray, energy: float) -> tuple[np.ndarray, np.ndarray]:
    """(z, y, x) means of the attenuation over the fine voxels of each voxel, in 1/cm, and where any is metal."""
    each = [float(mass_attenuation(one.material, energy)) * one.density for one in structure.substances]
    values = np.array([0.0, *each], np.float32)
    size = structure.fine // _FINE
    truth, metal = np.empty((size,) * 3, np.float32), np.empty((size,) * 3, bool)

    def one_slice(k: int) -> None:
        blocks: Any = labels[_FINE * k : _FINE * (k + 1)].reshape(_FINE, size, _FINE, size, _FINE)
        truth[k] = values[blocks].mean(axis=(0, 2, 4))
        metal[k] = (blocks == METAL).any(axis=(0, 2, 4))

    run_tasks(one_slice, [(k,) for k in range(size)])
    return truth, metal

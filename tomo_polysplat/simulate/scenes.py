"""The named scenes, scanned: from a name to projections with their truth.

A scene is the same object at every size; the size only sets how finely it is sampled.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_choice, require_number
from tomo_polysplat.free_memory import require_memory
from tomo_polysplat.parallel import run_tasks
from tomo_polysplat.physics.detector import Detector
from tomo_polysplat.physics.materials import density, mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum, require_spectrum
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate import (
    scene_broccoli,
    scene_lung,
    scene_pancreas,
    scene_pepper,
    scene_pins,
    scene_teeth,
)
from tomo_polysplat.simulate.chords import trace_view
from tomo_polysplat.simulate.orbit import circular_orbit, view_vectors
from tomo_polysplat.simulate.phantom import Part, Phantom
from tomo_polysplat.simulate.scanner import Scanner, transmission
from tomo_polysplat.simulate.truth import voxelise_truth

__all__ = ["SCENES", "Scene", "scan_bytes", "scan_phantom", "scene_phantom", "simulate_scan"]


@dataclass(frozen=True)
class Scene:
    """A named object.

    Attributes
    ----------
    parts : callable
        Gives its parts in order of precedence.
    half_width : float
        Half the edge of the cubic volume about it, in cm; the detector sees all of that volume in every view.
    metal : str
        What its metal is made of unless told otherwise.
    """

    parts: Callable[[], list[Part]]
    half_width: float
    metal: str = "iron"


SCENES = {
    "pins": Scene(scene_pins.parts, scene_pins.HALF_WIDTH),
    "teeth": Scene(scene_teeth.parts, scene_teeth.HALF_WIDTH),
    "lung": Scene(scene_lung.parts, scene_lung.HALF_WIDTH),
    "broccoli": Scene(scene_broccoli.parts, scene_broccoli.HALF_WIDTH),
    "pancreas": Scene(scene_pancreas.parts, scene_pancreas.HALF_WIDTH, "titanium"),
    "pepper": Scene(scene_pepper.parts, scene_pepper.HALF_WIDTH),
}

# Of a ray with its mark, and of a voxel of the truth with its own; that there is twice while it is put together.
_BYTES = 5


def scene_phantom(scene: str, metal: bool | str = True) -> Phantom:
    """The phantom of a named scene: with its metal (True), without (False) or with the metal named."""
    chosen, phantom = SCENES[require_choice("scene", scene, SCENES)], _made(scene)
    if metal is False:
        return phantom.with_metal(None)
    name = chosen.metal if metal is True else metal
    if not isinstance(name, str):
        raise fail("metal", "True, False or the name of a metal", repr(metal), error=TypeError)
    return phantom.with_metal(name, density(name))


@functools.cache
def _made(scene: str) -> Phantom:
    """Once for all sizes and metals: to strew the parts of some takes a fifth of a second."""
    return Phantom(SCENES[scene].parts())


def scan_bytes(size: int, views: int, geometry: str) -> int:
    """Bytes that `simulate_scan` makes by default: projections with their marks, the truth and its metal mask."""
    columns = _usual_pixels(size)
    rows, slices = (1, 1) if geometry == "fan" else (columns, size)
    return _BYTES * (rows * views * columns + slices * size**2)


def _usual_pixels(size: int) -> int:
    return -(-3 * size // 2)


# One parameter for each option that a caller names.
def simulate_scan(
    scene: str,
    size: int = 64,
    views: int = 180,
    *,
    metal: bool | str = True,
    kvp: float = 90.0,
    filters: dict[str, float] | None = None,
    detector: Detector | None = None,
    spectrum: Spectrum | None = None,
    photons: float = 1e5,
    electronic_noise: float = 3.0,
    scatter: float = 0.0,
    seed: int = 0,
    noise: bool = True,
    geometry: str = "cone",
    rows: int | None = None,
    columns: int | None = None,
    subrays: int = 1,
    arc_degrees: float | None = None,
) -> Scan:
    """Scan a named scene.

    Parameters
    ----------
    scene : str
        One of ``SCENES``: pins, teeth, lung, broccoli, pancreas (with titanium), pepper.
    size : int
        Voxels per edge of the volume.
    views : int
    metal : bool or str
        True for the scene's own metal, False for the metal-free control, or a metal such as "titanium".
    kvp : float
        Tube voltage of a tungsten tube.
    filters : dict, optional
        Filter thicknesses in cm by material; None stands for 1 mm of aluminium.
    detector : Detector, optional
        Its response; None for ideal photon counting.
    spectrum : Spectrum, optional
        Used instead of the one that ``kvp``, ``filters`` and ``detector`` describe.
    photons, electronic_noise, scatter, noise, seed
        See :class:`~tomo_polysplat.simulate.scanner.Scanner`; the seed sets the noise, never the object.
    geometry : "cone", "parallel" or "fan"
        A fan is one detector row and one slice in the plane z = 0.
    rows, columns : int, optional
        Detector pixels, 1.5 ``size`` unless told (a fan has one row). The detector always sees the whole
        object, so other numbers change the size of its pixels.
    subrays : int
        Rays per pixel and axis, whose transmissions are averaged. 1, the default, takes the ray through the
        pixel's centre, as reconstructions do; 2 or more blurs edges as real pixels do, non-linearly at metal.
    arc_degrees : float, optional
        Angle covered by the views, the end point left out: 360 for a cone or fan and 180 for a parallel beam.

    Returns
    -------
    Scan
        In cm. Its truth is antialiased, in 1/cm at the spectrum's effective energy, its metal mask holds
        every voxel with any metal, and its ``notes`` the settings and the number of starved rays.

    Raises
    ------
    ValueError
        For an unknown name, a size or number out of range; the message says which.
    MemoryError
        For a scan or a truth that this machine has no room for.
    """
    size = _count("size", size)
    chosen = SCENES[require_choice("scene", scene, SCENES)]
    columns = _count("columns", _usual_pixels(size) if columns is None else columns)
    rows = 1 if geometry == "fan" else _count("rows", _usual_pixels(size) if rows is None else rows)
    if arc_degrees is None:
        arc_degrees = 180.0 if geometry == "parallel" else 360.0
    arc = require_number("arc_degrees", arc_degrees, above=0.0)
    _require_room(rows * _count("views", views) * columns, size**2 * (1 if geometry == "fan" else size))
    angles = np.deg2rad(arc) * np.arange(_count("views", views)) / views
    proj_geom, vol_geom = circular_orbit(geometry, chosen.half_width, size, rows, columns, angles)
    spectrum = require_spectrum("spectrum", spectrum)
    if spectrum is None:
        spectrum = Spectrum.from_tube(
            kvp, filters={"Al": 0.1} if filters is None else filters, detector=detector or "counting"
        )
    scan = scan_phantom(
        scene_phantom(scene, metal),
        proj_geom,
        vol_geom,
        spectrum,
        Scanner(photons, electronic_noise, scatter, noise, seed),
        subrays=_count("subrays", subrays),
        name=f"{scene}-{'control' if metal is False else chosen.metal if metal is True else metal}",
    )
    scan.notes.update(scene=scene, metal=metal, geometry=geometry, arc_degrees=arc)
    return scan


# One parameter for each option that a caller names.
def scan_phantom(
    phantom: Phantom,
    proj_geom: dict[str, Any],
    vol_geom: dict[str, Any],
    spectrum: Spectrum,
    scanner: Scanner,
    subrays: int = 1,
    name: str = "phantom",
) -> Scan:
    """Scan any phantom with any cone or parallel ASTRA geometry of three-dimensional type, in cm.

    Parameters
    ----------
    phantom : Phantom
    proj_geom, vol_geom : dict
        ASTRA geometries; the volume geometry carries its window in cm.
    spectrum : Spectrum
    scanner : Scanner
    subrays : int
        Rays per pixel and axis; see :func:`simulate_scan`.
    name : str

    Returns
    -------
    Scan
    """
    attenuation = _mass_attenuations(phantom, spectrum.energies)
    projections, valid = _measure(phantom, proj_geom, attenuation, spectrum.weights, scanner, subrays)
    window = vol_geom["option"]
    lower, upper = (np.array([window[f"Window{end}{axis}"] for axis in "XYZ"]) for end in ("Min", "Max"))
    shape = (vol_geom["GridSliceCount"], vol_geom["GridRowCount"], vol_geom["GridColCount"])
    energy = float(spectrum.effective_energy)
    at_energy = _mass_attenuations(phantom, np.array([energy]))[:, 0]
    truth, metal_mask = voxelise_truth(phantom, at_energy, shape, lower, upper, planar=shape[0] == 1)
    starved = int(valid.size - valid.sum())
    return Scan(
        projections=projections,
        proj_geom=proj_geom,
        vol_geom=vol_geom,
        unit="cm",
        spectrum=spectrum,
        truth=truth,
        metal_mask=metal_mask,
        truth_energy_kev=energy,
        name=name,
        valid=None if starved == 0 else valid,
        notes={"starved_rays": starved, "photons": scanner.photons, "seed": scanner.seed},
    )


def _measure(phantom, proj_geom, attenuation, weights, scanner, subrays):
    """Projections (rows, views, columns) and their validity, view by view over the CPU threads."""
    cone, vectors = view_vectors(proj_geom)
    rows, columns = proj_geom["DetectorRowCount"], proj_geom["DetectorColCount"]
    projections = np.empty((rows, len(vectors), columns), np.float32)
    valid = np.empty(projections.shape, bool)
    solids = phantom.solids()

    def one_view(view: int) -> None:
        beam, corner, u, v = vectors[view]
        # Sub-rays are the pixels of a finer detector of the same outline.
        corner = corner - (subrays - 1) / (2 * subrays) * (u + v)
        areal = np.zeros((rows * subrays, columns * subrays, len(phantom.materials)))
        trace_view(cone, beam, corner, u / subrays, v / subrays, solids, areal)
        passed = transmission(areal, attenuation, weights).reshape(rows, subrays, columns, subrays)
        counts = scanner.counts(passed.mean(axis=(1, 3)), view)
        projections[:, view], valid[:, view] = scanner.projection(counts)

    run_tasks(one_view, [(view,) for view in range(len(vectors))])
    return projections, valid


def _mass_attenuations(phantom: Phantom, energies: np.ndarray) -> np.ndarray:
    return np.stack([mass_attenuation(material, energies) for material in phantom.materials])


def _require_room(rays: int, voxels: int) -> None:
    """Refuse a scan, or its truth, that memory does not hold."""
    needed = {
        "views": (f"{rays} rays", float(rays * _BYTES)),
        "size": (f"{voxels} voxels", float(voxels * 2 * _BYTES)),
    }
    require_memory(needed, {"views": "take fewer views, rows or columns", "size": "take fewer voxels"})


def _count(argument: str, value: Any) -> int:
    number = require_number(argument, value, at_least=1)
    if number != int(number):
        raise fail(argument, "a whole number", repr(value))
    return int(number)

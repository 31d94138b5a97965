"""Scans small enough to be reconstructed in a fraction of a second, each simulated once."""

from functools import cache
from unittest import mock

import astra
import numpy as np
import pytest

import tomo_polysplat as tps
from tomo_polysplat import reconstruction
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.materials import density, mass_attenuation
from tomo_polysplat.scan.geometry import Geometry, from_astra, to_astra

# Two passes over the views in a few steps: enough to see every part at work. What pixels and source did to the light is
# asked in files of its own, as scatter is.
QUICK = {"passes": 2.0, "views_per_step": 8, "gains": False, "drift": False}
# That the light is asked about, which is usual.
ASKED = {"gains": None, "drift": None}

# A run that only something else ends, and that asks nothing by short fits.
ENDLESS = QUICK | {
    "passes": 10_000.0,
    "patience": 10_000,
    "tv_factor": 1.0,
    "edges": "blurred",
    "pixel_rays": 1,
}


@cache
def fan(metal=True):
    """Pins (or their metal-free control) in one plane: 40 views of 72 pixels, 48 x 48 voxels."""
    return tps.simulate_scan("pins", size=48, views=40, geometry="fan", metal=metal)


@cache
def cone(size=18, views=40, metal=False):
    return tps.simulate_scan("pins", size=size, views=views, metal=metal)


def reconstruct(scan, projections=None, proj_geom=None, vol_geom=None, **options):
    """A quick polychromatic reconstruction; what is not given is the scan's, which stood where it says."""
    usual = {
        "spectrum": scan.spectrum,
        "unit": scan.unit,
        "settings": QUICK,
        "align": False,
        "calibrate": False,
    }
    options = usual | options
    return tps.reconstruct(
        scan.projections if projections is None else projections,
        proj_geom or scan.proj_geom,
        vol_geom or scan.vol_geom,
        **options,
    )


class _Reached(Exception):
    """What `reconstruct` has made of its arguments, before it solves anything."""


def posed(*arguments, **options):
    """The problem that `reconstruct` would solve, and its counts of rays: all that its solver knows of the rays."""

    def reach(*made):
        raise _Reached(*pose(*made)[:2])

    pose = reconstruction._problem
    with mock.patch.object(reconstruction, "_problem", reach), pytest.raises(_Reached) as reached:
        reconstruct(*arguments, **options)
    return reached.value.args


def disc(core, spectrum, *, water=1.0, half=0.25):
    """A disc of some material in one of water of so many g/cm3, 60 views of a parallel beam in closed form.

    Projections and geometries in cm, of 45 x 45 voxels over twice ``half``: the water is 0.9 of that wide, the
    core 0.3, both around the middle.
    """
    width = 2.4 * half / 61
    proj_geom = astra.create_proj_geom("parallel", width, 61, np.arange(60) * np.pi / 60)
    vol_geom = astra.create_vol_geom(45, 45, -half, half, -half, half)
    across = (np.arange(61) - 30) * width
    outer, inner = (2 * half * np.sqrt(np.clip(r**2 - (across / half) ** 2, 0.0, None)) for r in (0.9, 0.3))
    curves = [mass_attenuation(material, spectrum.energies) for material in ("water", core)]
    paths = np.stack([water * (outer - inner), density(core) * inner])
    row = projection(paths, np.log(np.maximum(spectrum.weights, 1e-30)), np.stack(curves))
    return np.broadcast_to(row, (60, 61)).astype(np.float32), proj_geom, vol_geom


def geometries(scan) -> tuple[Geometry, object]:
    return from_astra(scan.proj_geom, scan.vol_geom)


def scaled(scan, factor):
    """The scan's geometries with every length times ``factor``."""
    geometry, grid = geometries(scan)
    return to_astra(geometry.scaled(factor), grid.scaled(factor))


def window(vol_geom):
    """The six numbers of a volume geometry's window."""
    return [vol_geom["option"][f"Window{end}{axis}"] for axis in "XYZ" for end in ("Min", "Max")]


def in_two_dimensions(scan):
    """Projections (views, columns) and 2D geometries of a scan of one row."""
    vectors = astra.geom_2vec(scan.proj_geom)["Vectors"]
    flat = vectors[:, [0, 1, 3, 4, 6, 7]]
    proj_geom = astra.create_proj_geom("fanflat_vec", scan.columns, np.ascontiguousarray(flat))
    _, ny, nx = scan.volume_shape
    return scan.projections[0], proj_geom, astra.create_vol_geom(ny, nx, *window(scan.vol_geom)[:4])


def relative(volume, reference):
    """Largest difference over the largest value."""
    return float(np.abs(volume - reference).max() / np.abs(reference).max())

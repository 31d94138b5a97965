"""How large an artefact filtered backprojection makes of each scene: large, and due to the metal."""

import numpy as np
import pytest

from tomo_polysplat.result.metrics import compare
from tomo_polysplat.scan.astra_geometry import from_astra, projections_from_astra
from tomo_polysplat.simulate.scenes import SCENES, simulate_scan
from tomo_polysplat.start.fdk import fdk


def reconstruct(scan):
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    return fdk(projections_from_astra(scan.projections, scan.proj_geom), geometry, grid)


@pytest.mark.parametrize("scene", SCENES)
def test_metal_spoils_the_slices_it_lies_in(scene):
    """Error outside metal, in the slices with metal, against the same voxels of the metal-free control."""
    scan, control = (simulate_scan(scene, 24, 48, metal=metal) for metal in (True, False))
    slices = scan.metal_mask.any(axis=(1, 2))
    rest = ~scan.metal_mask[slices]
    with_metal, without = (
        float(np.sqrt(np.mean((reconstruct(s) - s.truth)[slices][rest] ** 2))) for s in (scan, control)
    )
    assert with_metal > 1.8 * without
    assert with_metal > 0.06 * scan.truth[~scan.metal_mask].max()


def test_pins_in_decibels():
    scan, control = (simulate_scan("pins", 48, 90, metal=metal) for metal in (True, False))
    spoiled = compare(reconstruct(scan), scan.truth, scan.metal_mask)
    clean = compare(reconstruct(control), control.truth, control.metal_mask)
    assert 6 < spoiled["psnr"] < 14
    assert 33 < spoiled["psnr_all"] < 42
    assert clean["psnr"] > spoiled["psnr"] + 6

"""Structures with detail everywhere, and their scans."""

import numpy as np
import pytest
import torch

from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.simulate.structures import METAL, SOLID, STRUCTURES, Structure
from tomo_polysplat.simulate.voxel_scan import scan_structure
from tomo_polysplat.start.joseph import JosephProjector


@pytest.mark.parametrize("kind", STRUCTURES)
def test_slabs_make_the_whole_however_it_is_cut(kind):
    make = Structure(kind, 34, 6.0, seed=3).slabs()
    whole = make(0, 34)
    assert torch.equal(torch.cat([make(0, 11), make(11, 12), make(12, 34)]), whole)
    assert set(whole.unique().tolist()) == {0, 1, 2, METAL}
    assert not torch.equal(Structure(kind, 34, 6.0, seed=4).slabs()(0, 34), whole)


@pytest.mark.parametrize("kind", STRUCTURES)
def test_detail_is_about_as_wide_as_it_is_told(kind):
    """Mean runs of solid and matrix along x, in the inner half: between a half and twice the feature, grains larger."""
    widths = []
    for feature in (4.0, 8.0):
        labels = Structure(kind, 96, feature, metal=False, seed=1).slabs()(24, 72).numpy()
        solid = labels[:, 24:72, 24:72] == SOLID
        widths.append(solid.sum() / max(np.count_nonzero(np.diff(solid.astype(int), axis=2) == 1), 1))
    assert 0.5 * 4 < widths[0] < 3.5 * 4 and widths[1] / widths[0] == pytest.approx(2.0, rel=0.35)


def test_a_scan_is_its_truth_projected_at_one_energy_and_hardens_at_many():
    """Without noise worth mentioning."""
    options = {"columns": 31, "feature": 4, "metal": False, "photons": 1e12}
    scan = scan_structure("bone", 23, 9, spectrum=Spectrum(np.array([60.0]), np.array([1.0])), **options)
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    seen = JosephProjector(geometry, grid).forward(scan.truth, np.arange(9)).transpose(1, 0, 2)
    thick = seen > 0.3
    assert np.median(scan.projections[thick] / seen[thick]) == pytest.approx(1.0, abs=0.02)
    assert np.abs(scan.projections - seen).max() < 0.2 * seen.max()
    assert np.corrcoef(scan.projections.ravel(), seen.ravel())[0, 1] > 0.99
    many = scan_structure("bone", 23, 9, **options).projections
    thin, dense = (many[part].mean() / seen[part].mean() for part in ((seen > 0.02) & (seen < 0.1), thick))
    assert thin > 1.1 * dense


@pytest.mark.parametrize("metal", [True, False])
def test_voxels_of_one_substance_have_its_attenuation(metal):
    scan = scan_structure("grains", 22, 4, feature=5, metal=metal)
    quartz = 2.65 * float(mass_attenuation("SiO2", scan.truth_energy_kev))
    near = np.abs(scan.truth - quartz) < 1e-4 * quartz
    assert near.mean() > 0.1 and scan.metal_mask.any() == metal
    assert (scan.truth.max() > 10 * quartz) == metal and scan.truth.min() == 0
    assert scan.projections.shape == (33, 4, 33)


def test_sizes_that_make_no_sense_are_refused():
    with pytest.raises(ValueError, match="kind"):
        scan_structure("cheese", 24)
    with pytest.raises(ValueError, match="feature"):
        scan_structure("bone", 24, feature=0.5)

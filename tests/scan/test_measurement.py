"""What is named beside a scan takes the place of its own."""

import dataclasses

import numpy as np
import pytest
from small_scans import fan

from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.measurement import Measurement

NOTHING = dict.fromkeys(field.name for field in dataclasses.fields(Measurement))


def of(**told):
    return Measurement(**(NOTHING | told))


def test_a_scan_fills_what_is_not_named():
    scan = dataclasses.replace(fan(), unit="mm", water_correction=(0.0, 1.0))
    filled = of(projections=scan).filled()
    assert filled.projections is scan.projections and filled.unit == "mm"
    assert filled.geometries() == (scan.proj_geom, scan.vol_geom)
    assert filled.spectrum is scan.spectrum and filled.water_correction == (0.0, 1.0)
    mine = {
        "unit": "um",
        "spectrum": Spectrum([60.0], [1.0]),
        "valid": np.ones(1),
        "water_correction": [0.0, 2.0],
    }
    named = of(projections=scan, **mine).filled()
    assert all(getattr(named, name) is value for name, value in mine.items())


def test_a_correction_made_for_a_spectrum_goes_with_one_only():
    scan = dataclasses.replace(fan(), spectrum=None, water_correction=(0.0, 1.0))
    assert of(projections=scan).filled().water_correction is None


@pytest.mark.parametrize("name", ["proj_geom", "vol_geom"])
def test_an_array_alone_has_no_geometry(name):
    told = {"proj_geom": {}, "vol_geom": {}} | {name: None}
    with pytest.raises(ValueError, match=f"{name}.*pass a Scan"):
        of(projections=np.zeros((1, 2, 3)), **told).filled().geometries()

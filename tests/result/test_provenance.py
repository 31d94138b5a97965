"""What a result says about the scan and the software that it was made from and with."""

import numpy as np
import pytest
import torch

import tomo_polysplat as tps
from tomo_polysplat.result.provenance import provenance
from tomo_polysplat.scan.geometry import from_astra

CPU = torch.device("cpu")


@pytest.mark.parametrize("beam", ["cone", "parallel"])
def test_it_tells_the_scanner_in_its_own_unit(beam):
    pixels = (0.3, 0.2, 7, 9)
    angles = np.linspace(0, 6, 5)
    proj_geom = {
        "type": beam if beam == "cone" else "parallel3d",
        **dict(zip(("DetectorSpacingX", "DetectorSpacingY", "DetectorRowCount", "DetectorColCount"), pixels)),
        "ProjectionAngles": angles,
        "DistanceOriginSource": 12.5,
        "DistanceOriginDetector": 4.0,
    }
    window = {f"Window{end}{axis}": sign for end, sign in (("Min", -1.0), ("Max", 1.0)) for axis in "XYZ"}
    vol_geom = {"GridRowCount": 5, "GridColCount": 10, "GridSliceCount": 4, "option": window}
    told = provenance(*from_astra(proj_geom, vol_geom), "mm", tps.Spectrum.from_tube(90), CPU)
    assert told["geometry"].startswith(
        f"{beam} beam, 5 views of 9 x 7 pixels of 0.3 x 0.2 mm (columns, rows)"
    )
    assert ("12.5 mm from the middle" in told["geometry"]) == (beam == "cone")
    assert told["volume"] == "10 x 5 x 4 voxels of 0.2 x 0.4 x 0.5 mm (x, y, z)"
    assert "90 kV" in told["spectrum"] and told["device"] == "CPU"
    assert f"tomo-polysplat {tps.__version__}" in told["software"] and "torch" in told["software"]

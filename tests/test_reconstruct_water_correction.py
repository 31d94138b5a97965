"""Scans that carry a scanner's water correction, through the public calls."""

import dataclasses

import numpy as np
import pytest
import small_scans

from tomo_polysplat.result.metrics import compare
from tomo_polysplat.scan.io import load_scan, save_scan

SCANNER = (0.0, 1.2, 0.1, 0.01)


def corrected(scan):
    """What a scanner with that correction hands out."""
    values = scan.projections.astype(np.float64)
    return sum(c * values**k for k, c in enumerate(SCANNER)).astype(np.float32)


def test_a_corrected_scan_gives_the_volume_of_the_uncorrected_one():
    scan = small_scans.fan(metal=False)
    plain = small_scans.reconstruct(scan).volume
    told = small_scans.reconstruct(scan, corrected(scan), water_correction=SCANNER)
    untold = small_scans.reconstruct(scan, corrected(scan)).volume
    errors = [
        compare(volume.reshape(scan.truth.shape), scan.truth, scan.metal_mask)["psnr"]
        for volume in (plain, told.volume, untold)
    ]
    assert errors[1] == pytest.approx(errors[0], abs=0.3)
    assert errors[2] < errors[0] - 3.0, "the correction must be large enough to matter"
    assert "0.1 P^2" in told.plan["water_correction"].why


def test_a_correction_that_the_values_exceed_is_refused():
    scan = small_scans.fan()
    with pytest.raises(ValueError, match="water_correction: expected a polynomial that rises"):
        small_scans.reconstruct(scan, water_correction=(0.0, 1.0, -0.2))
    with pytest.raises(ValueError, match="c_0 = 0"):
        small_scans.reconstruct(scan, water_correction=(1.0, 0.02))


def test_without_a_spectrum_there_is_nothing_to_undo():
    with pytest.raises(ValueError, match="water_correction: expected a spectrum"):
        small_scans.reconstruct(small_scans.fan(), spectrum=None, water_correction=SCANNER)


@pytest.mark.parametrize("ending", ["npz", "h5"])
def test_files_carry_it(tmp_path, ending):
    scan = dataclasses.replace(small_scans.fan(), water_correction=SCANNER)
    path = tmp_path / f"scan.{ending}"
    save_scan(scan, path)
    assert load_scan(path).water_correction == SCANNER
    assert load_scan(path, water_correction=(0.0, 2.0)).water_correction == (0.0, 2.0)
    save_scan(small_scans.fan(), path, overwrite=True)
    assert load_scan(path).water_correction is None

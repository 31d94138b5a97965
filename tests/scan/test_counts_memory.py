"""What a scan whose counts stay in their file takes of the host's memory, as the system counts it."""

import os
import subprocess
import sys

import pytest

# Peaks above what the process held before, in bytes a ray: of loading, and of making the rays of a fit.
PROGRAM = """
import sys
from dataclasses import replace
import h5py, numpy as np
import tomo_polysplat as tps
from tomo_polysplat.scan import counts, data_exchange
from tomo_polysplat.scan.usable import usable_rays

counts._BLOCK, counts._PART, data_exchange._STAYS = 1 << 19, 1 << 16, 1

def written(path, views, side):
    rng, line = np.random.default_rng(1), np.abs(np.linspace(-1, 1, side)) < 0.6
    with h5py.File(path, "w") as file:
        data = file.create_dataset("exchange/data", (views, side, side), "u2", chunks=(1, side, side))
        for view in range(views):
            data[view] = np.where(line, 4000, 20000) + rng.integers(0, 200, (side, side))
        white = np.full((2, side, side), 20000, "u2")
        white[:, 3, 5] = 0
        file["exchange/data_white"], file["exchange/theta"] = white, np.linspace(0, 180, views, endpoint=False)
    return path

def peak():  # of this program alone: ru_maxrss begins with that of the process that started it
    with open("/proc/self/status") as lines:
        return 1024 * next(int(line.split()[1]) for line in lines if line.startswith("VmHWM"))

def told(path, rays):
    before = peak()
    scan = tps.load_scan(path, centre=scan_side / 2, pixel_size=0.1, unit="mm")
    loaded = peak()
    values, _, _ = usable_rays(scan.projections, scan.proj_geom, scan.usable)
    assert values.nbytes == 4 * rays and scan.valid is not None
    return (loaded - before) / rays, (peak() - before) / rays

scan_side = 40
told(written(sys.argv[1] + "/few.h5", 20, scan_side), 20 * 1600)
scan_side = 320
print(*told(written(sys.argv[1] + "/many.h5", 120, scan_side), 120 * 320**2))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="/proc is Linux's")
def test_counts_take_nothing_and_the_rays_of_a_fit_five_bytes(tmp_path):
    """1.2e7 rays: loading takes a block; then there are a float32 and a mark for each, and two bytes in passing.

    As arrays a scan takes 5 bytes a ray, and what is made of it 7 besides.
    """
    environment = os.environ | {"OMP_NUM_THREADS": "2"}
    made = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(tmp_path)],
        env=environment, capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert made.returncode == 0, made.stderr
    loaded, whole = map(float, made.stdout.split()[-2:])
    assert loaded < 2.0 and 4.0 < whole < 8.0

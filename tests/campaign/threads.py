"""The same scans with 1, 2, 3 and 5 threads, and bound to one core: the same bits."""

from __future__ import annotations

import json
import os
import subprocess
import sys

from .record import Record

__all__ = ["the_same_bits"]

THREADS = (1, 2, 3, 5)
_COUNTS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
SOLVE = """
import hashlib, json, os, sys
if sys.argv[1] == "bound" and hasattr(os, "sched_setaffinity"):
    os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
import numpy as np
import tomo_polysplat as tps
found = {}
for name, scene, size, views, geometry, options in (
    ("few views", "teeth", 14, 20, "cone", {"calibrate": False}),
    ("metal", "pins", 32, 30, "fan", {"calibrate": False}),
    ("calibrated", "pins", 32, 30, "fan", {"calibrate": "scatter"}),
    ("parallel", "lung", 16, 40, "parallel", {}),
):
    scan = tps.simulate_scan(scene, size=size, views=views, geometry=geometry)
    result = tps.reconstruct(scan, settings={"passes": 4.0}, seed=3, **options)
    found[name] = hashlib.sha256(result.basis.tobytes() + result.gaussians["position"].tobytes()).hexdigest()
print(json.dumps(found))
"""


def the_same_bits(record: Record) -> None:
    """Solve each scan under each number of threads."""
    cases = {f"{count} threads": dict.fromkeys(_COUNTS, str(count)) for count in THREADS} | {"bound": {}}
    first: dict[str, str] = {}
    for case, environment in cases.items():
        what = f"threads: {case if case != 'bound' else 'bound to one core'}"
        command = [sys.executable, "-c", SOLVE, case]
        done = subprocess.run(
            command, env=os.environ | environment, capture_output=True, text=True, check=False
        )
        if done.returncode:
            record.found(what, "crashed", f"{what}: status {done.returncode}\n{done.stderr[-2000:]}")
            continue
        for name, digest in json.loads(done.stdout.splitlines()[-1]).items():
            record.tried(what)
            if first.setdefault(name, digest) != digest:
                record.found(what, "mixed", f"{what}: {name} has other bits than with {THREADS[0]} thread")

"""What is planned for is what torch takes, by its own count of what it allocates on the host."""

import json
import math

import numpy as np
import pytest
import torch
from small_scans import cone
from torch.profiler import ProfilerActivity, profile

import tomo_polysplat as tps
from tomo_polysplat.fit import memory
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.model import seed_samples
from tomo_polysplat.plan import first_gaussians

SPECTRA_ARE_DOUBTED = True  # the second seeds are those of one energy; see tests/conftest.py

WINDOW = 4 * 32 * 32
CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """Most bytes that were allocated at once in a stage, beyond what was there before it, and what it was for."""
    found, file = {}, tmp_path_factory.mktemp("trace") / "trace.json"

    def counted(name, function, told=lambda *arguments: None, at=1):
        calls = []

        def count(*arguments, **options):
            calls.append(0)
            if len(calls) != at:
                return function(*arguments, **options)
            with profile(activities=[ProfilerActivity.CPU], profile_memory=True) as profiled:
                made = function(*arguments, **options)
            profiled.export_chrome_trace(str(file))
            events = [e for e in json.loads(file.read_text())["traceEvents"] if e.get("name") == "[memory]"]
            sizes = [e["args"]["Bytes"] for e in sorted(events, key=lambda event: event["ts"])]
            found[name] = max(np.cumsum(sizes)), told(*arguments)
            return made

        return count

    scan = cone(32, 40, metal=True)
    with pytest.MonkeyPatch.context() as patch:
        # As in a volume that is many times as large as what is looked at together.
        patch.setattr(seed_samples, "_AT_ONCE", WINDOW)
        patch.setattr(
            first_gaussians, "seed_gaussians", counted("seeds", first_gaussians.seed_gaussians, at=2)
        )
        patch.setattr(EagerStep, "__call__", counted("step", EagerStep.__call__, lambda step, *_: step, at=3))
        patch.setattr(EagerStep, "_regularisation", counted("smoothing", EagerStep._regularisation))
        patch.setattr(FitScene, "basis_on_host", counted("volume", FitScene.basis_on_host))
        settings = {
            "passes": 1,
            "views_per_step": 2,
            "seed_spacing": 4.0,
            "curves": 3,
            "pixel_rays": 1,
            "growth": 1,
        }
        tps.reconstruct(scan, settings=settings, calibrate=False, device="cpu", progress=False)
    return found, math.prod(scan.volume_shape), scan.rows * scan.columns


def test_seeds(taken, monkeypatch):
    found, voxels, _ = taken
    monkeypatch.setattr(memory, "_WINDOW", WINDOW)
    counted = memory.start_bytes(voxels)
    # With the start, and the start in soft references.
    most = found["seeds"][0] + 8 * voxels
    assert 0.5 * counted < most <= counted
    assert memory.start_bytes(8 * voxels) > 7 * counted, "mostly voxels"


def test_a_step(taken):
    found, voxels, pixels = taken
    most, step = found["step"]
    gaussians = len(step.gaussians)
    told = memory.step_bytes(CPU, memory.StepSize(gaussians, views=2, pixels=pixels, voxels=voxels))
    # Samples of thin Gaussians are for the volume; parameters and their moments are there before.
    counted = sum(told.values()) - min(memory._SAMPLES, 27 * 12 * voxels)
    assert 0.5 * counted < most + 132 * gaussians <= counted
    smoothed = memory.step_bytes(CPU, memory.StepSize(0, 0, 0, voxels))["volumes"]
    assert smoothed > 0.5 * counted, "mostly voxels"


def test_smoothing(taken):
    """Besides the volume itself, which is not torch's."""
    found, voxels, _ = taken
    smoothed = memory._SMOOTHED["cpu"] * voxels
    assert 0.5 * smoothed < found["smoothing"][0] <= smoothed - 4 * voxels


def test_a_volume(taken):
    found, voxels, _ = taken
    most = found["volume"][0]
    assert (
        0.5 * memory._MADE * voxels < most <= memory._MADE * voxels + min(memory._SAMPLES, 27 * 12 * voxels)
    )

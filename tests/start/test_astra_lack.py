"""ASTRA without room on a GPU: an error of one kind, whether it raises or says nothing. The GPU is a fake."""

from types import SimpleNamespace

import astra
import astra.experimental
import numpy as np
import pytest
import torch
from astra.log import AstraError

from tomo_polysplat.baselines.arrays import sirt
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.start import astra_fdk, astra_pair
from tomo_polysplat.start.orbit import find_orbit

ANGLES = np.linspace(0, 2 * np.pi, 9, endpoint=False)


@pytest.fixture
def scan():
    made = astra.create_proj_geom("cone", 1.0, 1.0, 7, 8, ANGLES, 100.0, 50.0)
    return from_astra(made, astra.create_vol_geom(6, 6, 5))


@pytest.fixture(params=["told", "silent", "well"])
def told(request, monkeypatch):
    """How ASTRA ends, and whether torch gave back what it keeps before; the GPU is almost full."""
    given = []
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (16, 1 << 30))
    monkeypatch.setattr(torch.cuda, "empty_cache", lambda: given.append(request.param))
    monkeypatch.setattr(torch.cuda, "synchronize", lambda *_: None)
    monkeypatch.setattr(torch.cuda, "current_stream", lambda *_: SimpleNamespace(synchronize=lambda: None))
    monkeypatch.setattr(astra_pair, "free_bytes", lambda _: 16)
    return request.param, given


def ended(how, *results):
    if how == "told":
        raise AstraError("no room")
    if how == "well":
        for result in results:
            result[...] = 1.0


def checked(told, made):
    how, given = told
    if how == "well":
        assert float(made().min()) == 1.0
    else:
        with pytest.raises(RuntimeError, match="no room" if how == "told" else "ASTRA failed|out of memory"):
            made()
    assert given


@pytest.mark.parametrize("way", ["forward", "adjoint"])
def test_of_the_projector(way, scan, told, monkeypatch):
    monkeypatch.setattr(astra_pair, "gpu_index", lambda _: 0)
    monkeypatch.setattr(astra_pair.AstraPair, "_projector", lambda *_: 1)
    monkeypatch.setattr(astra.experimental, "direct_FP3D", lambda _, volume, rays: ended(told[0], rays))
    monkeypatch.setattr(astra.experimental, "direct_BP3D", lambda _, volume, rays: ended(told[0], volume))
    pair, views = astra_pair.AstraPair(*scan, torch.device("cpu")), np.arange(9)
    given = torch.zeros(scan[1].shape if way == "forward" else (9, 7, 8))
    checked(told, lambda: getattr(pair, way)(given, views))


@pytest.fixture
def linked(told, monkeypatch):
    """What ASTRA is given is kept here, and its algorithms end as ``told``."""
    kept = []
    monkeypatch.setattr(astra.data3d, "GPULink", lambda *_: None)
    monkeypatch.setattr(
        astra.data3d, "link", lambda kind, geometry, data: kept.append((kind, data)) or len(kept)
    )
    monkeypatch.setattr(astra.data3d, "delete", lambda _: None)
    for name in ("create", "delete"):
        monkeypatch.setattr(astra.algorithm, name, lambda _: 1)
    monkeypatch.setattr(
        astra.algorithm, "run", lambda *_: ended(told[0], *(data for kind, data in kept if kind == "-vol"))
    )
    return told


def test_of_filtered_backprojection(scan, told, monkeypatch):
    monkeypatch.setattr(astra_pair, "gpu_index", lambda _: 0)
    monkeypatch.setattr(astra_pair.AstraPair, "_projector", lambda *_: 1)
    monkeypatch.setattr(astra.experimental, "direct_BP3D", lambda _, volume, rays: ended(told[0], volume))
    orbit, _ = find_orbit(scan[0])
    checked(told, lambda: astra_fdk.fdk_cuda_tensor(torch.ones(9, 7, 8), *scan, orbit, "hann"))


def test_of_sirt(scan, linked):
    checked(linked, lambda: sirt._sirt_cuda(np.ones((9, 7, 8), np.float32), *scan, 5, 0))

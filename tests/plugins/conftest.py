"""The hosts, and a stand-in for the solver that takes milliseconds."""

import importlib
from importlib.util import find_spec

import numpy as np
import pytest
import tomopy_standin

import tomo_polysplat
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import from_astra, is_planar_geometry, projections_from_astra
from tomo_polysplat.start.initial import initial_volume

REAL_TOMOPY = find_spec("tomopy") is not None


@pytest.fixture(
    params=["standin", pytest.param("real", marks=pytest.mark.skipif(not REAL_TOMOPY, reason="no TomoPy"))]
)
def tomopy(request, monkeypatch):
    """TomoPy's protocol, and TomoPy itself where there is one; polysplat is registered."""
    host = (
        tomopy_standin.install(monkeypatch)
        if request.param == "standin"
        else importlib.import_module("tomopy")
    )
    assert "tomopy" in tomo_polysplat.register()
    # After an error TomoPy leaves this behind, and uses fewer threads ever after.
    monkeypatch.setenv("TOMOPY_PYTHON_THREADS", "64")
    return host


@pytest.fixture
def solver(monkeypatch):
    """Filtered backprojection in place of the solver, and the keywords it was called with."""
    calls = []

    def reconstruct(projections, proj_geom, vol_geom, **options):
        calls.append(options | {"projections": np.array(projections), "proj_geom": proj_geom})
        geometry, grid = from_astra(proj_geom, vol_geom)
        valid = options.get("valid")
        if valid is not None:
            valid = projections_from_astra(valid, proj_geom) > 0
        ordered = projections_from_astra(projections, proj_geom)
        volume, _ = initial_volume(ordered, geometry, grid, valid=valid)
        return Result(volume[None], grid, options["unit"], flipped_2d=is_planar_geometry(proj_geom))

    monkeypatch.setitem(vars(tomo_polysplat), "reconstruct", reconstruct)
    return calls

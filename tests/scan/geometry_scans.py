"""ASTRA geometries of every type, the vector ones with tilts, offsets and skew."""

import numpy as np
import pytest

astra = pytest.importorskip("astra")

ANGLES = np.linspace(0, 2 * np.pi, 5, endpoint=False) + 0.3
VOLUME = astra.create_vol_geom(4, 5, 6)


def scan_3d(kind, seed=0):
    """A geometry of any 3D type; the vector ones have every vector disturbed (tilts, offsets, skew)."""
    cone = "cone" in kind
    distances = (50.0, 30.0) if cone else ()
    base = "cone" if cone else "parallel3d"
    geometry = astra.create_proj_geom(base, 1.1, 0.7, 7, 12, ANGLES, *distances)
    if kind == base:
        return geometry
    vectors = astra.geom_2vec(geometry)["Vectors"]
    vectors = vectors + 0.05 * np.random.default_rng(seed).normal(size=vectors.shape)
    return astra.create_proj_geom(kind, 7, 12, vectors)


def scan_2d(kind):
    if kind.startswith("fanflat"):
        geometry = astra.create_proj_geom("fanflat", 1.3, 11, ANGLES, 50.0, 30.0)
    else:
        geometry = astra.create_proj_geom("parallel", 1.3, 11, ANGLES)
    return astra.geom_2vec(geometry) if kind.endswith("_vec") else geometry

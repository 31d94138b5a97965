"""The Joseph pair and SIRT."""

import numpy as np
import pytest
from start_phantoms import DISCS, SPHERES, chords, distance, relative_error, truth

from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.start.joseph import JosephProjector
from tomo_polysplat.start.sirt import sirt

astra = pytest.importorskip("astra")


def scan(kind, seed=0):
    """A small scan: arbitrary vectors, or planar."""
    rng = np.random.default_rng(seed)
    if kind == "fanflat":
        turn = np.linspace(0, 2 * np.pi, 24, endpoint=False)
        proj_geom = astra.create_proj_geom("fanflat", 1.9, 41, turn, 150.0, 80.0)
        return from_astra(proj_geom, astra.create_vol_geom(37, 43))
    distances = (150.0, 80.0) if kind == "cone_vec" else ()
    base = astra.create_proj_geom(
        kind.removesuffix("_vec"), 1.9, 2.3, 23, 31, np.linspace(0, 2 * np.pi, 17, endpoint=False), *distances
    )
    vectors = astra.geom_2vec(base)["Vectors"]
    # Tilts of every vector, and the beam from any side so that each axis is stepped along.
    vectors[:, 3:] += 0.2 * rng.normal(size=(17, 9))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    vectors = np.hstack([part @ turn for part in np.split(vectors, 4, axis=1)])
    vol_geom = astra.create_vol_geom(39, 52, 35, -20, 32, -25, 14, -18, 24)
    return from_astra(astra.create_proj_geom(kind, 23, 31, vectors), vol_geom)


@pytest.mark.parametrize("kind", ["cone_vec", "parallel3d_vec", "fanflat"])
def test_backprojection_is_the_adjoint(kind):
    """<A x, y> = <x, A' y>; float32 sums of about 1e5 terms of one sign leave some 1e-6."""
    geometry, grid = scan(kind)
    projector = JosephProjector(geometry, grid)
    rng = np.random.default_rng(1)
    x, y = rng.random(grid.shape, np.float32), rng.random(geometry.shape, np.float32)
    forward, adjoint = projector.forward(x), projector.adjoint(y)
    assert forward.any()
    left, right = np.vdot(forward.astype(np.float64), y), np.vdot(x.astype(np.float64), adjoint)
    assert left == pytest.approx(right, rel=1e-5)
    some = np.array([5, 2])
    np.testing.assert_array_equal(projector.forward(x, some), forward[some])
    left, right = (
        np.vdot(forward[some].astype(np.float64), y[some]),
        np.vdot(x, projector.adjoint(y[some], some)),
    )
    assert left == pytest.approx(right, rel=1e-5)


@pytest.mark.parametrize("kind", ["cone_vec", "parallel3d_vec", "fanflat"])
def test_backprojection_has_the_same_bits_for_any_number_of_threads(kind, monkeypatch):
    geometry, grid = scan(kind)
    y = np.random.default_rng(3).random(geometry.shape, np.float32)
    found = set()
    for threads in (1, 2, 3, 5, 200):
        monkeypatch.setattr("tomo_polysplat.start.joseph.cpu_threads", lambda threads=threads: threads)
        found.add(JosephProjector(geometry, grid).adjoint(y).tobytes())
    assert len(found) == 1


@pytest.mark.parametrize("kind", ["cone_vec", "parallel3d_vec", "fanflat"])
def test_projections_are_line_integrals(kind):
    """A wide smooth bump, for which interpolating linearly loses about 1 %."""
    geometry, grid = scan(kind)
    sigma, centre = 4.0, grid.centre
    bump = np.exp(-0.5 * (distance(grid, centre) / sigma) ** 2).astype(np.float32)
    projected = JosephProjector(geometry, grid).forward(bump)
    for view in range(geometry.views):
        origins, directions = geometry.rays(view)
        missed = np.linalg.norm(np.cross(centre - origins, directions), axis=-1)
        expected = np.sqrt(2 * np.pi) * sigma * np.exp(-0.5 * (missed / sigma) ** 2)
        np.testing.assert_allclose(projected[view], expected, atol=0.015 * expected.max())


def test_the_volume_behind_the_source_is_not_seen():
    proj_geom = astra.create_proj_geom("cone_vec", 1, 1, np.array([[0, 0, 0, 0, 9, 0, 1, 0, 0, 0, 0, 1.0]]))
    vol_geom = astra.create_vol_geom(8, 8, 8, -4, 4, 1, 9, -4, 4)
    geometry, grid = from_astra(proj_geom, vol_geom)
    behind = grid.shifted(np.array([0.0, -10.0, 0.0]))
    ones = np.ones(grid.shape, np.float32)
    assert JosephProjector(geometry, grid).forward(ones).item() == pytest.approx(8.0)
    assert JosephProjector(geometry, behind).forward(ones).item() == 0.0


def test_it_goes_the_way_of_astras_sirt():
    """The same data, no constraint: the residual falls as ASTRA's does, and the images agree."""
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    proj_geom = astra.create_proj_geom("fanflat", 1.5, 70, turn, 150.0, 80.0)
    vol_geom = astra.create_vol_geom(48, 48)
    geometry, grid = from_astra(proj_geom, vol_geom)
    projections = chords(geometry, DISCS)
    projector = astra.create_projector("line_fanflat", proj_geom, vol_geom)
    data = [astra.data2d.create("-sino", proj_geom, projections[:, 0]), astra.data2d.create("-vol", vol_geom)]
    config = astra.astra_dict("SIRT")
    config["ProjectorId"] = projector
    config["ProjectionDataId"], config["ReconstructionDataId"] = data
    algorithm = astra.algorithm.create(config)
    theirs = []
    for _ in range(15):
        image = astra.data2d.get(data[1])
        identifier, sinogram = astra.create_sino(image, projector)
        astra.data2d.delete(identifier)
        theirs.append(np.sqrt(np.mean((sinogram - projections[:, 0]) ** 2)))
        astra.algorithm.run(algorithm, 1)
    image = astra.data2d.get(data[1])[::-1]
    astra.algorithm.delete(algorithm)
    astra.data2d.delete(data)
    astra.projector.delete(projector)
    ours = []
    volume = sirt(
        projections,
        geometry,
        grid,
        passes=15,
        nonnegative=False,
        callback=lambda number, error, volume: ours.append(error),
    )
    np.testing.assert_allclose(ours, theirs, rtol=0.1)
    assert ours[-1] < 0.15 * ours[0]
    assert relative_error(volume[0], image, distance(grid, (0, 0, 0))[0] < 22) < 0.02


def test_subsets_save_passes():
    geometry, grid = from_astra(
        astra.create_proj_geom(
            "cone", 3.0, 3.0, 30, 30, np.linspace(0, 2 * np.pi, 30, endpoint=False), 150.0, 80.0
        ),
        astra.create_vol_geom(24, 24, 24, -24, 24, -24, 24, -24, 24),
    )
    projections = chords(geometry, SPHERES)
    expected, inside = truth(grid, SPHERES), distance(grid, (0, 0, 0)) < 22
    errors = {
        (subsets, passes): relative_error(
            sirt(projections, geometry, grid, passes=passes, subsets=subsets), expected, inside
        )
        for subsets, passes in ((1, 5), (1, 15), (5, 5))
    }
    assert errors[1, 15] < errors[1, 5]
    assert errors[5, 5] < 1.1 * errors[1, 15]


def test_masked_pixels_are_not_used():
    geometry, grid = scan("cone_vec")
    ball = [(tuple(grid.centre), 12.0, 0.05)]
    projections = chords(geometry, ball)
    expected = sirt(projections, geometry, grid, passes=8)
    valid = np.random.default_rng(3).random(geometry.shape) > 0.1
    spoiled = np.where(valid, projections, 50.0).astype(np.float32)
    masked = sirt(spoiled, geometry, grid, passes=8, valid=valid)
    missing = sirt(np.where(valid, projections, np.nan), geometry, grid, passes=8)
    np.testing.assert_array_equal(masked, missing)
    assert relative_error(masked, expected, slice(None)) < 0.05
    assert relative_error(sirt(spoiled, geometry, grid, passes=8), expected, slice(None)) > 1.0


def test_it_stays_nonnegative_and_stops_when_told():
    geometry, grid = scan("fanflat")
    projections = chords(geometry, DISCS) - np.float32(0.05)
    seen = []
    volume = sirt(
        projections, geometry, grid, passes=9, subsets=4, callback=lambda n, *rest: seen.append(n) or n == 2
    )
    assert seen == [0, 1, 2]
    assert volume.min() == 0.0
    assert sirt(projections, geometry, grid, passes=3, nonnegative=False).min() < 0


def test_unit_of_length():
    geometry, grid = scan("cone_vec")
    ball = [(tuple(grid.centre), 12.0, 0.05)]
    expected = sirt(chords(geometry, ball), geometry, grid, passes=4, subsets=3)
    volume = sirt(chords(geometry, ball), geometry.scaled(1e-3), grid.scaled(1e-3), passes=4, subsets=3)
    np.testing.assert_allclose(volume * 1e-3, expected, atol=1e-4 * expected.max())

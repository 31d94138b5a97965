"""Filtered backprojection of cone and parallel beams against closed forms, and where it does not apply."""

from functools import cache

import numpy as np
import pytest
import torch
from start_phantoms import SPHERES, chords, distance, paths, relative_error

from tomo_polysplat.scan.geometry import from_astra, to_astra
from tomo_polysplat.scan.moves import Scanner, moved_geometry
from tomo_polysplat.start.astra_fdk import weights_on
from tomo_polysplat.start.fdk import fdk, fits_fdk
from tomo_polysplat.start.filters import FILTERS
from tomo_polysplat.start.level import Level
from tomo_polysplat.start.orbit import find_orbit
from tomo_polysplat.start.weights import arcs_of_rows, pixel_weights, ray_arcs, ray_offsets, row_changes

astra = pytest.importorskip("astra")

TURN = np.linspace(0, 2 * np.pi, 90, endpoint=False)
VOLUME = astra.create_vol_geom(64, 64, 64)


def cone(angles=TURN, columns=96, rows=96, pixel=(1.6, 1.6), offset=(0.0, 0.0)):
    geometry = astra.create_proj_geom("cone", *pixel, rows, columns, angles, 200.0, 120.0)
    return astra.geom_postalignment(geometry, offset)


def parallel(angles=TURN / 2, columns=96, offset=0.0):
    geometry = astra.create_proj_geom("parallel3d", 1.0, 1.0, 64, columns, angles)
    return astra.geom_postalignment(geometry, (offset, 0.0))


@cache
def usual():
    """The spheres in an ordinary cone beam, which several tests compare with."""
    geometry, grid = from_astra(cone(), VOLUME)
    return geometry, grid, fdk(chords(geometry, SPHERES), geometry, grid)


def check_spheres(proj_geom, vol_geom=VOLUME, tolerance=0.01):
    geometry, grid = from_astra(proj_geom, vol_geom)
    assert fits_fdk(geometry, grid)[0]
    volume = fdk(chords(geometry, SPHERES), geometry, grid)
    assert volume.dtype == np.float32
    body = distance(grid, SPHERES[0][0])
    plain = body < 17
    for centre, radius, value in SPHERES[1:]:
        near = distance(grid, centre)
        plain &= near > radius + 2
        inside = volume[near < radius - 2]
        assert len(inside) > 8
        assert inside.mean() == pytest.approx(value + SPHERES[0][2], rel=tolerance)
        weight = np.where(near < radius + 2, volume - SPHERES[0][2], 0)
        x, y, z = grid.axes()
        found = [
            (weight.sum(axis=a) * c).sum() / weight.sum() for a, c in (((0, 1), x), ((0, 2), y), ((1, 2), z))
        ]
        assert np.abs(np.subtract(found, centre) / grid.voxel_size).max() < 0.1
    assert volume[plain].mean() == pytest.approx(SPHERES[0][2], rel=tolerance)
    assert abs(volume[(body > 22) & (body < 30)].mean()) < 0.005 * SPHERES[0][2]
    return volume


@pytest.mark.parametrize(
    "proj_geom",
    [
        pytest.param(parallel(), id="parallel half turn"),
        pytest.param(parallel(TURN), id="parallel full turn"),
        pytest.param(parallel(np.random.default_rng(0).permutation(TURN) - 7), id="parallel in any order"),
        pytest.param(cone(), id="cone"),
        pytest.param(cone(np.random.default_rng(1).permutation(-TURN)), id="cone backwards, in any order"),
        pytest.param(cone(np.arange(90) * np.deg2rad(111.246)), id="golden angle"),
        pytest.param(cone(rows=80, columns=110, pixel=(1.3, 2.0)), id="oblong pixels"),
        pytest.param(cone(offset=(9.0, 3.0), columns=110), id="shifted detector that covers the object"),
    ],
)
def test_spheres(proj_geom):
    check_spheres(proj_geom)


@pytest.mark.parametrize(
    "vol_geom",
    [
        pytest.param(
            astra.create_vol_geom(50, 64, 40, -20, 32, -25, 25, -18, 22), id="off centre, oblong voxels"
        ),
        pytest.param(astra.create_vol_geom(41, 55, 33, -22, 19, -24, 31, -13, 20), id="odd sizes"),
    ],
)
def test_spheres_in_other_windows(vol_geom):
    check_spheres(cone(), vol_geom)


@pytest.mark.parametrize(
    "proj_geom",
    [
        pytest.param(cone(columns=60, offset=(14.0, 0.0)), id="half fan"),
        pytest.param(cone(columns=60, offset=(-14.3, 3.0)), id="half fan, other side"),
        pytest.param(parallel(TURN, columns=50, offset=14.3), id="half-width parallel beam"),
        pytest.param(cone(np.linspace(0.3, 0.3 + np.deg2rad(212), 90)), id="short scan"),
        pytest.param(cone(-np.linspace(0.3, 0.3 + np.deg2rad(212), 90)), id="short scan backwards"),
        pytest.param(cone(np.linspace(0, np.deg2rad(300), 112)), id="overscan"),
    ],
)
def test_lines_measured_a_different_number_of_times(proj_geom):
    check_spheres(proj_geom, tolerance=0.02)


def moved(proj_geom, **values):
    """The same scan by a scanner that is rolled, tilted, slanted or skewed by so many degrees."""
    geometry, grid = from_astra(proj_geom, VOLUME)
    tensors = {name: torch.as_tensor(value, dtype=torch.float64) for name, value in values.items()}
    return to_astra(moved_geometry(Scanner(geometry), tensors), grid)[0]


SHORT = cone(np.linspace(0.3, 0.3 + np.deg2rad(212), 90), columns=104)


@pytest.mark.parametrize(
    ("proj_geom", "tolerance"),
    [
        pytest.param(moved(cone(), roll=-12.0), 0.01, id="roll"),
        pytest.param(moved(cone(), tilt=13.0, slant=9.0), 0.01, id="tilt and slant"),
        pytest.param(moved(cone(), roll=1.0, skew=2.0), 0.01, id="roll and skewed axis"),
        pytest.param(moved(parallel(), roll=7.0, tilt=-9.0, slant=5.0), 0.01, id="parallel"),
        pytest.param(moved(cone(columns=64, offset=(14.0, 0.0)), roll=5.0, tilt=6.0), 0.02, id="half fan"),
        pytest.param(moved(SHORT, roll=-6.0, tilt=8.0), 0.02, id="short scan"),
    ],
)
def test_spheres_before_a_detector_that_is_not_upright(proj_geom, tolerance):
    check_spheres(proj_geom, tolerance=tolerance)


# Ellipsoids with a vertical axis: centre, half-width and half-height.
PLATES = (((0.0, 0.0, 0.0), 20.0, 2.5), ((4.0, 3.0, 9.0), 14.0, 2.0), ((-5.0, 2.0, -9.0), 13.0, 2.0))


@cache
def plates():
    """Their volume, each voxel filled from the bottom to the top of what they reach of it."""
    grid = from_astra(cone(), VOLUME)[1]
    (x, y, z), volume = grid.axes(), np.zeros(grid.shape)
    for centre, wide, high in PLATES:
        left = wide**2 - (x - centre[0]) ** 2 - (y[:, None] - centre[1]) ** 2
        ends = np.sqrt(np.maximum(left, 0)) * high / wide
        top = np.minimum(z[:, None, None] + 0.5, centre[2] + ends)
        volume += np.maximum(top - np.maximum(z[:, None, None] - 0.5, centre[2] - ends), 0)
    return volume


def of_plates(proj_geom):
    """Error of the volume against the truth, relative."""
    geometry, grid = from_astra(proj_geom, VOLUME)
    projections = sum(
        paths(geometry, np.array(centre), wide, (1.0, 1.0, wide / high)) for centre, wide, high in PLATES
    )
    volume = fdk(projections.astype(np.float32), geometry, grid)
    return relative_error(volume, plates(), distance(grid, (0, 0, 0)) < 24)


def test_plates_before_a_rolled_detector():
    """Filtered along rows that cross them, plates paint streaks: five times the error."""
    upright = of_plates(cone())
    assert of_plates(moved(cone(), roll=10.0)) < 1.6 * upright
    assert of_plates(moved(cone(), roll=-3.0)) < 1.15 * upright


def test_arcs_of_other_rows_are_those_at_their_rays_distance_from_the_axis():
    geometry, grid = from_astra(moved(SHORT, roll=6.0, tilt=-9.0), VOLUME)
    geometry = Level(geometry).geometry
    orbit, _ = find_orbit(geometry)
    rows = np.array([0, 30, geometry.rows - 1])
    along, farther = row_changes(geometry)
    heights = torch.from_numpy(rows - 0.5 * (geometry.rows - 1))
    offsets = torch.from_numpy(ray_offsets(geometry, orbit))
    found = arcs_of_rows(offsets, torch.from_numpy(along), torch.from_numpy(farther), rows=heights).numpy()
    expected = np.stack([ray_offsets(geometry, orbit, row=row) for row in rows], axis=1)
    assert np.ptp(expected, axis=1).max() > 1
    low, high = offsets.numpy().min(axis=1)[:, None, None], offsets.numpy().max(axis=1)[:, None, None]
    np.testing.assert_allclose(found, np.clip(expected, low, high), atol=1e-3)


def narrow(angles):
    """A cone that is all but parallel: fans of 0.2 degrees."""
    return astra.create_proj_geom("cone", 1.0, 1.0, 64, 96, angles, 20000.0, 10.0)


@pytest.mark.parametrize("views", [60, 91])
@pytest.mark.parametrize("endpoint", [True, False])
def test_half_a_turn_of_a_narrow_cone_is_as_good_as_of_a_parallel_beam(views, endpoint):
    """The rays differ from parallel ones by an eighth of a degree, at the rim by 0.05 columns."""
    angles = np.linspace(0.3, 0.3 + np.pi, views, endpoint=endpoint)
    volumes = []
    for proj_geom in (narrow(angles), parallel(angles)):
        geometry, grid = from_astra(proj_geom, VOLUME)
        assert fits_fdk(geometry, grid)[0]
        volumes.append(fdk(chords(geometry, SPHERES), geometry, grid))
    assert volumes[1].max() > 0.05
    assert relative_error(*volumes, slice(None)) < 0.001


@pytest.mark.parametrize("degrees", [178.5, 180.0, 181.0, 185.0, 200.0, 260.0])
@pytest.mark.parametrize("distance_to_source", [150.0, 2e4])
def test_the_arcs_that_rays_stand_for_add_up_to_half_a_turn(degrees, distance_to_source):
    """In each column, that is, at each distance from the axis, whatever the arc, as soon as it takes in all lines."""
    angles = np.deg2rad(np.linspace(0, degrees, 91))
    angles[40] = angles[41]  # a view measured twice
    proj_geom = astra.create_proj_geom("cone", 1.0, 1.0, 3, 31, angles, distance_to_source, 10.0)
    geometry, grid = from_astra(proj_geom, astra.create_vol_geom(28, 28, 3))
    arcs = ray_arcs(geometry, find_orbit(geometry)[0], grid)
    assert (arcs >= -1e-12).all()
    if fits_fdk(geometry, grid)[0]:
        np.testing.assert_allclose(arcs.sum(axis=0), np.pi, rtol=0.002)
    assert fits_fdk(geometry, grid)[0] == (degrees > (195 if distance_to_source < 1e4 else 0))


def test_a_detector_turned_and_an_axis_moved():
    """The axis need not be the origin, nor the detector perpendicular to the line from source to axis."""
    vectors = astra.geom_2vec(cone(columns=120))["Vectors"]
    tilt = 0.15
    u, outwards = vectors[:, 6:9].copy(), vectors[:, 0:3] / 200.0
    vectors[:, 6:9] = np.cos(tilt) * u + np.sin(tilt) * 1.6 * outwards
    vectors[:, [0, 3]] += 11.0
    turned = astra.create_proj_geom("cone_vec", 96, 120, vectors)
    window = astra.create_vol_geom(64, 64, 64, -21, 43, -32, 32, -32, 32)
    geometry, grid = from_astra(turned, window)
    moved = [((c[0] + 11.0, c[1], c[2]), r, m) for c, r, m in SPHERES]
    volume = fdk(chords(geometry, moved), geometry, grid)
    expected = usual()[2]
    inside = distance(grid, moved[0][0]) < 26
    assert relative_error(volume, expected, inside) < 0.015


@pytest.mark.parametrize("factor", [1e-3, 1e3])
def test_the_unit_of_length_only_scales_the_values(factor):
    geometry, grid, expected = usual()
    scaled = geometry.scaled(factor)
    volume = fdk(chords(scaled, SPHERES, factor), scaled, grid.scaled(factor))
    np.testing.assert_allclose(volume, expected * 1.0, atol=2e-4 * expected.max())


def test_magnification_does_not_matter():
    _, grid, expected = usual()
    far = astra.create_proj_geom("cone", 3.2, 3.2, 96, 96, TURN, 200.0, 440.0)
    geometry, _ = from_astra(far, VOLUME)
    volume = fdk(chords(geometry, SPHERES), geometry, grid)
    np.testing.assert_allclose(volume, expected, atol=1e-4 * expected.max())


def test_smooth_filters_blur_noise():
    geometry, grid = from_astra(parallel(columns=64), astra.create_vol_geom(32, 32, 8))
    noise = np.random.default_rng(2).normal(size=geometry.shape).astype(np.float32)
    spread = {name: fdk(noise, geometry, grid, filter_name=name).std() for name in FILTERS}
    assert spread["ram-lak"] > spread["shepp-logan"] > spread["cosine"] > spread["hann"]


def test_slices_that_no_view_sees_are_empty():
    geometry, grid = from_astra(
        astra.create_proj_geom("parallel3d", 1.0, 1.0, 9, 40, TURN / 2), astra.create_vol_geom(24, 24, 16)
    )
    volume = fdk(np.ones(geometry.shape, np.float32), geometry, grid)
    assert not volume[:3].any()
    assert not volume[-3:].any()
    assert volume[4:12].any(axis=(1, 2)).all()


@pytest.mark.parametrize(("columns", "offset"), [(40, 0.0), (72, 4.0), (72, -4.0)])
def test_half_a_turn_of_a_detector_that_is_short_on_both_sides_or_a_little_on_one_fits(columns, offset):
    assert fits_fdk(*from_astra(parallel(columns=columns, offset=offset), VOLUME))[0]


def tilted():
    vectors = astra.geom_2vec(cone())["Vectors"]
    vectors[:, 9] += 0.6
    return astra.create_proj_geom("cone_vec", 96, 96, vectors)


def helix():
    vectors = astra.geom_2vec(cone())["Vectors"]
    vectors[:, [2, 5]] += np.linspace(-20, 20, 90)[:, None]
    return astra.create_proj_geom("cone_vec", 96, 96, vectors)


def laminography():
    vectors = astra.geom_2vec(parallel())["Vectors"]
    vectors[:, 2] = 0.5
    return astra.create_proj_geom("parallel3d_vec", 64, 96, vectors)


@pytest.mark.parametrize(
    ("proj_geom", "said"),
    [
        pytest.param(tilted(), "detector is tilted", id="tilt"),
        pytest.param(helix(), "horizontal circle", id="helix"),
        pytest.param(laminography(), "beam is tilted", id="laminography"),
        pytest.param(
            cone(np.linspace(0, np.pi, 60)), "180 degrees of arc where 198", id="half a turn of a cone"
        ),
        pytest.param(parallel(np.linspace(0, 2.0, 60)), "115 degrees of arc where 180", id="limited angle"),
        pytest.param(cone(columns=20, offset=(15.0, 0.0)), "does not reach the shadow", id="axis not seen"),
        pytest.param(parallel(columns=48, offset=16.0), "one side", id="half turn that sees one side"),
        pytest.param(parallel(columns=48, offset=-16.0), "one side", id="half turn that sees the other side"),
        pytest.param(
            cone(np.linspace(0, np.deg2rad(230), 120), columns=60, offset=(22.0, 0.0)),
            "one side",
            id="short scan that sees one side",
        ),
        pytest.param(cone(TURN[:2]), "fewer than three views", id="two views"),
    ],
)
def test_what_does_not_fit_is_refused_with_the_reason(proj_geom, said):
    geometry, grid = from_astra(proj_geom, VOLUME)
    fits, reason = fits_fdk(geometry, grid)
    assert not fits
    assert said in reason
    with pytest.raises(ValueError, match="use sirt"):
        fdk(np.zeros(geometry.shape, np.float32), geometry, grid)


def test_wrong_arguments_are_named():
    geometry, grid = from_astra(cone(), VOLUME)
    with pytest.raises(ValueError, match=r"shape \(90, 96, 96\) \(views, rows, columns\)"):
        fdk(np.zeros((96, 90, 96), np.float32), geometry, grid)
    with pytest.raises(ValueError, match="filter_name: expected one of ram-lak"):
        fdk(np.zeros(geometry.shape, np.float32), geometry, grid, filter_name="sharp")


# Every kind of scan that filtered backprojection fits.
_KINDS = {
    "cone": cone(),
    "cone of an odd width": cone(columns=101),
    "oblong pixels": cone(rows=80, columns=110, pixel=(1.3, 2.0)),
    "backwards, in any order": cone(np.random.default_rng(1).permutation(-TURN)),
    "uneven steps": cone(TURN + 0.02 * np.sin(5 * TURN)),
    "axis off": cone(offset=(1.7, -2.2)),
    "half fan": cone(columns=60, offset=(14.0, 0.0)),
    "short scan": cone(np.linspace(0.3, 0.3 + np.deg2rad(212), 90)),
    "parallel": parallel(),
    "half-width parallel": parallel(TURN, columns=50, offset=14.3),
    "rolled and tilted cone": moved(cone(), roll=5.0, tilt=-7.0),
    "rolled and tilted half fan": moved(cone(columns=64, offset=(14.0, 0.0)), roll=-4.0, tilt=6.0),
    "rolled and tilted short scan": moved(SHORT, roll=3.0, tilt=8.0),
    "rolled and tilted parallel": moved(parallel(), roll=5.0, tilt=-7.0, slant=4.0),
    "skewed half-width parallel": moved(parallel(TURN, columns=64, offset=14.3), roll=3.0, skew=2.0),
}


@pytest.mark.parametrize("kind", _KINDS)
def test_weights_by_polynomials_are_those_of_rays(kind):
    geometry, grid = from_astra(_KINDS[kind], VOLUME)
    geometry = Level(geometry).geometry
    orbit, _ = find_orbit(geometry)
    arcs, some = ray_arcs(geometry, orbit, grid), slice(3, 9)
    found = weights_on(torch.device("cpu"), geometry, orbit, arcs)(some).numpy()
    expected = pixel_weights(geometry, orbit, arcs, some)
    assert expected.max() > 0
    found = np.broadcast_to(found, expected.shape)
    np.testing.assert_allclose(found, expected, rtol=2e-6, atol=1e-7 * expected.max())


@pytest.mark.gpu
@pytest.mark.parametrize("kind", _KINDS)
def test_a_gpu_makes_the_same_volume(kind):
    import os

    from tomo_polysplat.start.astra_fdk import suits_fdk_cuda
    from tomo_polysplat.start.slabs import fdk_cuda

    geometry, grid = from_astra(_KINDS[kind], VOLUME)
    if not torch.cuda.is_available():
        assert not suits_fdk_cuda(geometry)[0]
        assert os.environ.get("POLYSPLAT_REQUIRE_GPU") != "1", "no GPU to test on"
        pytest.skip("no GPU")
    assert suits_fdk_cuda(geometry)[0]
    # Away from the origin, and voxels that are no cubes.
    shift = np.array([5.0, -3.0, 2.0])
    moved = geometry.shifted(shift)
    _, oblong = from_astra(cone(), astra.create_vol_geom(50, 64, 40, -32, 32, -32, 32, -32, 32))
    for scanner, voxels in ((geometry, grid), (moved, grid.shifted(shift)), (geometry, oblong)):
        spheres = [(np.add(c, voxels.centre), r, m) for c, r, m in SPHERES]
        projections = chords(scanner, spheres)
        orbit, _ = find_orbit(scanner)
        expected = fdk(projections, scanner, voxels)
        volume = fdk_cuda(projections, scanner, voxels, orbit)
        within = distance(voxels, voxels.centre) < 26
        # Textures interpolate by weights of 8 bits.
        assert relative_error(volume, expected, within) < 0.002
        np.testing.assert_array_equal(fdk_cuda(projections, scanner, voxels, orbit), volume)


@pytest.mark.gpu
@pytest.mark.parametrize("filter_name", FILTERS)
def test_rows_are_filtered_as_astra_filters_them(filter_name):
    from tomo_polysplat.start.slabs import fdk_cuda

    geometry, grid = from_astra(cone(), VOLUME)
    projections = chords(geometry, SPHERES)
    data = (
        astra.data3d.create("-sino", cone(), projections.swapaxes(0, 1)),
        astra.data3d.create("-vol", VOLUME),
    )
    config = astra.astra_dict("FDK_CUDA")
    config["ProjectionDataId"], config["ReconstructionDataId"] = data
    config["option"] = {"FilterType": filter_name}
    algorithm = astra.algorithm.create(config)
    astra.algorithm.run(algorithm)
    expected = astra.data3d.get(data[1])
    astra.algorithm.delete(algorithm)
    astra.data3d.delete(data)
    volume = fdk_cuda(projections, geometry, grid, find_orbit(geometry)[0], filter_name=filter_name)
    within = distance(grid, grid.centre) < 30
    assert np.abs(volume - expected)[within].max() < 1e-3 * np.abs(expected).max()


def test_our_geometry_in_astras_terms_reconstructs_the_same():
    geometry, grid = from_astra(cone(), astra.create_vol_geom(24, 24, 24))
    again, voxels = from_astra(*to_astra(geometry, grid))
    projections = chords(geometry, SPHERES)
    same = fdk(projections, again, voxels)
    np.testing.assert_allclose(same, fdk(projections, geometry, grid), atol=1e-6)

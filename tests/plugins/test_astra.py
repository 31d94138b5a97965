"""ASTRA's plugin: the same volume as ``reconstruct``, from the geometries of the data objects."""

import astra  # noqa: TID253
import numpy as np
import pytest
import torch

import tomo_polysplat
from tomo_polysplat.plugins import AstraOptions

VIEWS, COLUMNS, ROWS = 30, 15, 7
ANGLES = np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)
CONE = astra.create_proj_geom("cone", 1.0, 1.0, ROWS, COLUMNS, ANGLES, 40.0, 10.0)
FAN = astra.create_proj_geom("fanflat", 1.0, COLUMNS, ANGLES, 40.0, 10.0)
SPACE, PLANE = astra.create_vol_geom(9, 10, 6), astra.create_vol_geom(9, 10)
GEOMETRIES = {
    "cone": (CONE, SPACE),
    "cone_vec": (astra.geom_2vec(CONE), SPACE),
    "parallel3d": (astra.create_proj_geom("parallel3d", 1.0, 1.0, ROWS, COLUMNS, ANGLES), SPACE),
    "fanflat_vec": (astra.geom_2vec(FAN), PLANE),
    "parallel": (astra.create_proj_geom("parallel", 1.0, COLUMNS, ANGLES), PLANE),
}


@pytest.fixture(autouse=True)
def registered():
    assert "astra" in tomo_polysplat.register()
    yield
    astra.clear()


def data(kind):
    """ASTRA's module for a geometry, and projections in its order."""
    proj_geom, _ = GEOMETRIES[kind]
    planar = "DetectorCount" in proj_geom
    shape = (VIEWS, COLUMNS) if planar else (ROWS, VIEWS, COLUMNS)
    values = np.random.default_rng(0).random(shape).astype(np.float32)
    return astra.data2d if planar else astra.data3d, values


def algorithm(sinogram, volume, **options):
    config = astra.astra_dict("POLYSPLAT")
    config |= {"ProjectionDataId": sinogram, "ReconstructionDataId": volume, "option": options}
    return astra.algorithm.create(config)


@pytest.mark.parametrize("kind", GEOMETRIES)
def test_every_geometry_gives_the_same_as_reconstruct(kind, solver):
    proj_geom, vol_geom = GEOMETRIES[kind]
    module, values = data(kind)
    sinogram, volume = module.create("-sino", proj_geom, values), module.create("-vol", vol_geom)
    number = algorithm(sinogram, volume, Seed=3, TimeBudget=2.5, Options=AstraOptions(unit="mm"))
    astra.algorithm.run(number)
    direct = tomo_polysplat.reconstruct(values, proj_geom, vol_geom, unit="mm")
    # ASTRA keeps angles in float32.
    np.testing.assert_allclose(module.get(volume), direct.volume, atol=1e-6)
    assert direct.volume.std() > 1e-3
    assert {"seed": 3, "time_budget": 2.5, "unit": "mm"}.items() <= solver[0].items()
    result = astra.algorithm.get_plugin_object(number).result
    np.testing.assert_array_equal(result.volume, module.get(volume))


@pytest.mark.parametrize(("iterations", "settings"), [(0, None), (1, None), (12, {"passes": 12.0})])
def test_iterations_are_passes(iterations, settings, solver):
    module, values = data("parallel")
    sinogram = module.create("-sino", GEOMETRIES["parallel"][0], values)
    number = algorithm(sinogram, module.create("-vol", PLANE), Options=AstraOptions(unit="cm"))
    astra.algorithm.run(number, iterations)
    assert solver[0].get("settings") == settings


def test_options_travel_in_one_object(solver):
    module, values = data("parallel")
    sinogram = module.create("-sino", GEOMETRIES["parallel"][0], values)
    valid = np.ones(values.shape, bool)
    options = AstraOptions(unit="mm", filters={"Al": 0.1}, kvp=90, settings={"tv_weight": 0}, valid=valid)
    astra.algorithm.run(algorithm(sinogram, module.create("-vol", PLANE), Options=options, Passes=3))
    assert solver[0]["settings"] == {"tv_weight": 0, "passes": 3.0} and solver[0]["valid"] is valid
    assert "Al" in solver[0]["spectrum"].label
    assert options.options["settings"] == {"tv_weight": 0}
    astra.algorithm.run(algorithm(sinogram, module.create("-vol", PLANE), Options=options))
    assert solver[1]["settings"] == {"tv_weight": 0}


@pytest.mark.parametrize(
    "bad",
    [
        {"File": "a,b"},
        {"Options": "a,b;c"},
        {"Options": {"unit": "mm"}},
        {"Seed": "1,2"},
        {"Seed": None},
        {"TimeBudget": np.zeros(0)},
        {"Seed": [1, 2]},
    ],
    ids=str,
)
def test_options_that_would_abort_the_process_are_refused_first(bad):
    with pytest.raises((ValueError, TypeError), match="option"):
        algorithm(1, 2, **bad)


def test_wrong_options_are_refused():
    with pytest.raises(ValueError, match="options: expected one of"):
        AstraOptions(spektrum=3)
    with pytest.raises(ValueError, match="kvp"):
        AstraOptions(filters={"Al": 0.1})


def test_other_algorithms_are_left_alone():
    module, values = data("parallel")
    sinogram = module.create("-sino", GEOMETRIES["parallel"][0], values)
    config = astra.astra_dict("FBP")
    config |= {"ProjectionDataId": sinogram, "ReconstructionDataId": module.create("-vol", PLANE)}
    config |= {
        "ProjectorId": astra.create_projector("linear", GEOMETRIES["parallel"][0], PLANE),
        "option": {"FilterType": "hann"},
    }
    assert astra.algorithm.create(config) > 0


def test_linked_host_memory(solver):
    proj_geom, vol_geom = GEOMETRIES["cone"]
    _, values = data("cone")
    projections, target = torch.from_numpy(values), torch.zeros(6, 9, 10)
    sinogram = astra.data3d.link("-sino", proj_geom, projections)
    volume = astra.data3d.link("-vol", vol_geom, target)
    astra.algorithm.run(algorithm(sinogram, volume, Options=AstraOptions(unit="cm")))
    expected = tomo_polysplat.reconstruct(values, proj_geom, vol_geom, unit="cm").volume
    np.testing.assert_allclose(target.numpy(), expected, atol=1e-6)


@pytest.mark.gpu
def test_linked_cuda_tensors():
    """ASTRA cannot hand out memory of a GPU, so the tensors come along in the options."""
    proj_geom, vol_geom = GEOMETRIES["cone"]
    _, values = data("cone")
    projections, target = torch.from_numpy(values).cuda(), torch.zeros(6, 9, 10).cuda()
    sinogram = astra.data3d.link("-sino", proj_geom, projections)
    volume = astra.data3d.link("-vol", vol_geom, target)
    with pytest.raises(Exception, match="pass the tensors"):
        astra.algorithm.run(algorithm(sinogram, volume))
    options = AstraOptions(projections=projections, reconstruction=target, settings={"passes": 1})
    number = algorithm(sinogram, volume, Options=options)
    astra.algorithm.run(number)
    assert torch.isfinite(target).all() and float(target.std()) > 0
    result = astra.algorithm.get_plugin_object(number).result
    np.testing.assert_array_equal(target.cpu().numpy(), result.volume)


def test_the_solver_itself():
    proj_geom, vol_geom = GEOMETRIES["parallel"]
    position = np.arange(COLUMNS) + 0.5 - COLUMNS / 2
    chord = 2 * np.sqrt(
        np.clip(3.0**2 - (position - (np.cos(ANGLES) + np.sin(ANGLES))[:, None]) ** 2, 0, None)
    )
    values = 0.1 * chord.astype(np.float32)
    sinogram, volume = astra.data2d.create("-sino", proj_geom, values), astra.data2d.create("-vol", vol_geom)
    # ASTRA's geometry comes back rounded, and few rays with little smoothing, as of so thin a disc, make that show.
    settings = {"passes": 4, "tv_factor": 1}
    astra.algorithm.run(algorithm(sinogram, volume, Options=AstraOptions(unit="cm", settings=settings)))
    direct = tomo_polysplat.reconstruct(values, proj_geom, vol_geom, unit="cm", settings=settings)
    recon = astra.data2d.get(volume)
    np.testing.assert_allclose(recon, direct.volume, atol=1e-3)
    rows, columns = np.mgrid[:9, :10]
    mass = recon.clip(0).sum()
    # The disc is at x = y = 1; row 0 is at the largest y.
    assert (recon.clip(0) * (columns - 4.5)).sum() / mass == pytest.approx(1, abs=0.2)
    assert (recon.clip(0) * (4 - rows)).sum() / mass == pytest.approx(1, abs=0.2)

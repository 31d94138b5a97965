"""Filtered backprojection in the plane, against closed forms and ASTRA's CPU algorithms."""

import numpy as np
import pytest
from start_phantoms import DISCS, chords, distance, relative_error, truth

from tomo_polysplat.scan.geometry import from_astra, projections_from_astra, volume_from_astra
from tomo_polysplat.start.fdk import fdk

astra = pytest.importorskip("astra")


def planar_cases(views=180):
    half, turn = np.linspace(0, np.pi, 90, endpoint=False), np.linspace(0, 2 * np.pi, views, endpoint=False)
    square, window = astra.create_vol_geom(64, 64), astra.create_vol_geom(50, 64, -24, 40, -20, 30)
    fan = astra.create_proj_geom("fanflat", 1.5, 90, turn, 150.0, 80.0)
    beam = astra.create_proj_geom("parallel", 1.0, 80, half)
    return {
        "parallel": (beam, square),
        "parallel window": (beam, window),
        "parallel offset": (astra.geom_postalignment(beam, 5.25), square),
        "fan": (fan, square),
        "fan window": (fan, window),
        "fan offset": (astra.geom_postalignment(fan, 4.5), square),
    }


def astra_2d(algorithm, proj_geom, vol_geom, sinogram, iterations=1):
    kind = "line_fanflat" if proj_geom["type"].startswith("fan") else "linear"
    projector = astra.create_projector(kind, proj_geom, vol_geom)
    data = [astra.data2d.create("-sino", proj_geom, sinogram), astra.data2d.create("-vol", vol_geom)]
    config = astra.astra_dict(algorithm)
    config["ProjectorId"] = projector
    config["ProjectionDataId"], config["ReconstructionDataId"] = data
    identifier = astra.algorithm.create(config)
    astra.algorithm.run(identifier, iterations)
    image = astra.data2d.get(data[1])
    astra.algorithm.delete(identifier)
    astra.data2d.delete(data)
    astra.projector.delete(projector)
    return volume_from_astra(image, vol_geom)


@pytest.mark.parametrize("case", planar_cases())
def test_discs(case):
    geometry, grid = from_astra(*planar_cases()[case])
    volume = fdk(chords(geometry, DISCS), geometry, grid)
    assert relative_error(volume, truth(grid, DISCS), distance(grid, (0, 0, 0)) < 30) < 0.02


@pytest.mark.parametrize("case", ["parallel", "parallel window"])
def test_discs_as_astras_fbp(case):
    """Its FBP knows parallel beams only; the two differ by 0.6 % of the largest value."""
    proj_geom, vol_geom = planar_cases()[case]
    geometry, grid = from_astra(proj_geom, vol_geom)
    projections = chords(geometry, DISCS)
    expected = astra_2d("FBP", proj_geom, vol_geom, projections[:, 0])
    volume = fdk(projections, geometry, grid)
    inside = distance(grid, (0, 0, 0)) < 30
    assert relative_error(volume, expected, inside) < 0.01
    assert volume[inside].mean() == pytest.approx(expected[inside].mean(), rel=1e-3)


@pytest.mark.parametrize("case", ["fan", "fan window", "fan offset", "parallel offset"])
def test_discs_as_astras_sirt(case):
    """From ASTRA's own projections of an image: the detector runs, and the image lies, as ASTRA has it."""
    proj_geom, vol_geom = planar_cases(120)[case]
    geometry, grid = from_astra(proj_geom, vol_geom)
    image = truth(grid, DISCS).astype(np.float32)
    kind = "line_fanflat" if proj_geom["type"].startswith("fan") else "linear"
    projector = astra.create_projector(kind, proj_geom, vol_geom)
    identifier, sinogram = astra.create_sino(np.ascontiguousarray(image[0, ::-1]), projector)
    astra.data2d.delete(identifier)
    astra.projector.delete(projector)
    expected = astra_2d("SIRT", proj_geom, vol_geom, sinogram, 60)
    volume = fdk(projections_from_astra(sinogram, proj_geom), geometry, grid)
    inside = distance(grid, (0, 0, 0)) < 28
    assert relative_error(volume, expected, inside) < 0.035
    assert relative_error(volume, image, inside) < 0.02
    assert relative_error(volume[:, ::-1], image, inside) > 0.1

"""A start beside opaque metal: discs and spheres, whose line integrals are chords."""

import math

import numpy as np
import pytest
import torch
from start_phantoms import chords, distance

from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.moves import Scanner, moved_geometry
from tomo_polysplat.start import bridged
from tomo_polysplat.start.bridged import box_around, bridged_start
from tomo_polysplat.start.initial import initial_volume_on
from tomo_polysplat.start.voxel_projector import projector_pair

astra = pytest.importorskip("astra")

BODY, METAL = 0.02, 1.0
# Two pieces of metal in a body; the last number is what is added to the body's attenuation.
PIECES = (((0.0, 0.0, 0.0), 20.0, BODY), ((-10.0, 1.0, 0.0), 2.5, METAL), ((9.0, 1.0, 0.0), 3.0, METAL))
# No ray measured more than this: a detector sees no light behind more.
DARKEST = 3.0


def fan(views=90):
    angles = np.linspace(0, 2 * np.pi, views, endpoint=False)
    proj_geom = astra.create_proj_geom("fanflat", 1.0, 91, angles, 150.0, 80.0)
    return from_astra(proj_geom, astra.create_vol_geom(51, 51, -25.5, 25.5, -25.5, 25.5))


def cone(views=60):
    angles = np.linspace(0, 2 * np.pi, views, endpoint=False)
    proj_geom = astra.create_proj_geom("cone", 2.0, 2.0, 41, 45, angles, 150.0, 80.0)
    return from_astra(
        proj_geom, astra.create_vol_geom(35, 35, 35, -26.25, 26.25, -26.25, 26.25, -26.25, 26.25)
    )


def starts(geometry, grid, pieces=PIECES, darkest=DARKEST, metal=6 * BODY):
    values = torch.from_numpy(chords(geometry, pieces)).clamp(max=darkest)
    volume, done = initial_volume_on(values, geometry, grid)
    return volume, *bridged_start(values, volume, done["method"], geometry, grid, metal=metal)


def between(grid):
    """Voxels of the body between the pieces and clear of both."""
    x, y, z = grid.axes()
    beside = np.minimum(*(distance(grid, centre) - radius for centre, radius, _ in PIECES[1:])) > 2.5
    line = (
        (np.abs(x) < 6)[None, None, :]
        & (np.abs(y - 1) < 1.5)[None, :, None]
        & (np.abs(z) < 1.5)[:, None, None]
    )
    return torch.from_numpy(line & beside & (distance(grid, (0, 0, 0)) < 17))


def rolled():
    geometry, grid = cone()
    degrees = {"roll": 4.0, "tilt": -3.0}
    values = {name: torch.tensor(value, dtype=torch.float64) for name, value in degrees.items()}
    return moved_geometry(Scanner(geometry), values), grid


@pytest.mark.parametrize("scan", [fan, cone, rolled])
def test_matter_between_opaque_metal_is_not_lost(scan):
    geometry, grid = scan()
    volume, bridged, why = starts(geometry, grid)
    where = between(grid)
    assert int(where.sum()) > 10
    # Rays through both pieces are far too bright for what the others say: the first start is dark there.
    assert float(volume[where].mean()) < 0.6 * BODY
    assert float(bridged[where].mean()) == pytest.approx(BODY, rel=0.15)
    assert "bridged, which misses" in why


@pytest.mark.parametrize("scan", [fan, cone, rolled])
def test_rays_through_the_box_around_metal_are_those_through_the_volume(scan):
    geometry, grid = scan()
    generator, mask = torch.Generator().manual_seed(2), torch.zeros(grid.shape, dtype=torch.bool)
    depth = grid.shape[0] // 3
    # Up to one of the volume's ends, and away from the others.
    mask[depth : 2 * depth + 1, :9, 7:20] = torch.rand((depth + 1, 9, 13), generator=generator) > 0.7
    within, views = box_around(mask), np.arange(geometry.shape[0])
    assert within[1].start == 0 and int(mask[within].sum()) == int(mask.sum()) > 5
    assert math.prod(mask[within].shape) < 0.3 * mask.numel()
    box = grid.box(within)
    np.testing.assert_allclose(box.voxel_size, grid.voxel_size, rtol=1e-12)
    lines = []
    for part, voxels in ((grid, mask), (box, mask[within])):
        with projector_pair(geometry, part, mask.device) as pair:
            lines.append(pair.forward(voxels.float(), views))
    torch.testing.assert_close(*lines, rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("scan", [fan, cone, rolled])
def test_the_prior_is_needed_where_rays_meet_metal_alone(scan, monkeypatch):
    geometry, grid = scan()
    window = []
    found = bridged._ends
    monkeypatch.setattr(
        bridged, "_ends", lambda met: window.append((*found(met), len(met))) or window[-1][:2]
    )
    _, near, why = starts(geometry, grid)
    assert "bridged, which misses" in why
    # Some of the detector is left out, at both ends of its columns.
    assert window[-1][0] > 0 and window[-1][1] < window[-1][2]
    monkeypatch.setattr(bridged, "_ends", lambda met: (0, len(met)))
    _, whole, _ = starts(geometry, grid)
    torch.testing.assert_close(near, whole, rtol=1e-4, atol=1e-4 * BODY)


def test_metal_itself_stays():
    volume, bridged, _ = starts(*fan())
    mask = volume > 6 * BODY
    assert int(mask.sum()) > 20
    assert torch.equal(bridged[mask], volume[mask])
    assert not torch.equal(bridged, volume)


def test_rays_that_agree_are_not_thrown_away():
    # Large pieces, and rays that are exact however dark: bridging them can only lose what they say.
    pieces = (
        PIECES[0],
        ((-9.0, 1.0, 0.0), 5.0, 0.3),
        ((9.0, 1.0, 0.0), 5.0, 0.3),
        ((0.0, -9.0, 0.0), 3.0, 0.1),
    )
    volume, bridged, why = starts(*fan(), pieces=pieces, darkest=np.inf)
    assert torch.equal(bridged, volume)
    assert "not bridged" in why


def test_too_much_metal_cannot_be_bridged():
    pieces = (PIECES[0], ((0.0, 0.0, 0.0), 14.0, METAL))
    volume, bridged, why = starts(*fan(), pieces=pieces)
    assert torch.equal(bridged, volume)
    assert "of the object's rays pass through it" in why


def test_without_metal_nothing_is_done():
    volume, bridged, why = starts(*fan(), pieces=PIECES[:1])
    assert bridged is volume
    assert why == ""


def test_few_views_are_left_alone():
    volume, bridged, why = starts(*fan(views=20))
    assert bridged is volume
    assert "too few views" in why


def test_rays_that_were_not_measured_do_no_harm():
    geometry, grid = fan()
    values = torch.from_numpy(chords(geometry, PIECES)).clamp(max=DARKEST)
    values[:, :, 40] = torch.nan
    values[7] = torch.nan
    volume, done = initial_volume_on(values, geometry, grid)
    bridged, why = bridged_start(values, volume, done["method"], geometry, grid, metal=6 * BODY)
    assert bool(torch.isfinite(bridged).all())
    assert "bridged, which misses" in why
    assert float(bridged[between(grid)].mean()) == pytest.approx(BODY, rel=0.2)

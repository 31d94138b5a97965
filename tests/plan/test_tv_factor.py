"""How much is smoothed: by how much light an object takes away, and by what rays held out of short fits say."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from tomo_polysplat import reconstruct
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.plan.decisions.tv_factor import _misfit_aside, _Tries
from tomo_polysplat.settings import Settings

SIZE, VIEWS = 64, 90
# Where the question is how the error scales, a quarter of the voxels tells it as well.
SMALL = {"views": 48, "size": 32}
FLAT = ((0.0, 0.0, 0.85, 0.5), (0.3, 0.2, 0.2, 0.1), (-0.35, 0.1, 0.15, -0.2), (0.0, -0.4, 0.1, 0.2))


def laminate(size):
    """Rings of 2 pixels."""
    radii = np.arange(0.85, 0.1, -4 / size)
    return tuple((0.0, 0.0, radius, 0.5 * (-1) ** k) for k, radius in enumerate(radii))


RINGS = laminate(SIZE)


def slice_of(discs, noise, denser=1.0, views=VIEWS, size=SIZE):
    """Exact line integrals of discs (x, y, radius, attenuation) in a parallel beam, their geometries, and the truth."""
    discs = [(x, y, radius, denser * mu) for x, y, radius, mu in discs]
    angles = np.linspace(0, np.pi, views, endpoint=False)
    pixel, columns = 2 / size, round(1.3 * size)
    s = pixel * (np.arange(columns) - (columns - 1) / 2)
    # Nine points across a voxel and either way tell its mean well enough.
    fine = (np.arange(9 * size) + 0.5) / (9 * size) * 2 - 1
    projections, truth = np.zeros((views, columns)), np.zeros((9 * size,) * 2)
    for x, y, radius, mu in discs:
        off = s - (x * np.cos(angles) + y * np.sin(angles))[:, None]
        projections += 2 * mu * np.sqrt(np.maximum(radius**2 - off**2, 0))
        truth += mu * ((fine - x) ** 2 + (fine[::-1, None] - y) ** 2 < radius**2)
    projections += np.random.default_rng(0).normal(0, noise, projections.shape)
    proj_geom = {
        "type": "parallel",
        "DetectorWidth": pixel,
        "DetectorCount": columns,
        "ProjectionAngles": angles,
    }
    window = {"WindowMinX": -1.0, "WindowMaxX": 1.0, "WindowMinY": -1.0, "WindowMaxY": 1.0}
    vol_geom = {"GridRowCount": size, "GridColCount": size, "option": window}
    return (
        projections.astype(np.float32),
        proj_geom,
        vol_geom,
        truth.reshape(size, 9, size, 9).mean(axis=(1, 3)),
    )


def fitted(scan, **settings):
    usual = {"passes": 10, "views_per_step": 10, "held_out": 0.03, "gains": False, "drift": False}
    settings = usual | settings
    # Where the scanner stood, and what it did to the light, is asked in other files.
    return reconstruct(*scan[:3], unit="cm", settings=settings, progress=False, align=False)


def relative_error(volume, truth):
    return np.sqrt(np.square(volume - truth).mean()) / truth.max()


@pytest.mark.parametrize(
    ("discs", "noise", "denser", "views", "size", "more"),
    [(FLAT, 0.05, 1, 60, 40, True), (RINGS, 0.05, 1.6, VIEWS, SIZE, False)],
)
def test_more_smoothing_is_taken_where_held_out_rays_want_it_and_lowers_the_error(
    discs, noise, denser, views, size, more
):
    scan = slice_of(discs, noise, denser, views, size)
    found, once, thrice = (fitted(scan, **chosen) for chosen in ({}, {"tv_factor": 1}, {"tv_factor": 3}))
    assert (
        "misfit of the held-out rays" in found.plan["tv_factor"].why
        and "asked for" in once.plan["tv_factor"].why
    )
    # The short fits leave no trace: it is the run that asks for what they told.
    assert np.array_equal(found.volume, (thrice if more else once).volume)
    once, thrice = (np.square(result.volume - scan[3]).mean() for result in (once, thrice))
    assert thrice < 0.8 * once if more else once < 0.8 * thrice


@pytest.mark.parametrize("discs", [FLAT, laminate(SMALL["size"])])
@pytest.mark.parametrize("passes", [10, 5])
def test_a_tenth_of_the_attenuation_and_of_the_noise_gives_a_tenth_of_the_volume(discs, passes):
    # Half the passes need as many steps.
    errors, run = [], {"passes": passes, "views_per_step": 6 if passes == 10 else 3}
    for denser in (1.0, 0.1):
        scan = slice_of(discs, 0.002 * denser, denser, **SMALL)
        errors.append(relative_error(fitted(scan, **run).volume, scan[3]))
    assert errors[1] < 1.5 * errors[0]
    # What the usual weight makes of it, or the start if that is worse.
    assert relative_error(fitted(scan, **run, tv_factor=1).volume, scan[3]) > 1.5 * errors[1]


def test_where_smooth_things_are_thin_held_out_rays_keep_the_usual_weight():
    # Its noise is all that varies.
    scan = slice_of(FLAT[:1], 0.02, 0.3, views=66, size=48)
    found = fitted(scan, views_per_step=6)
    assert found.plan["tv_factor"].why.startswith("the usual weight: after")
    less = fitted(scan, views_per_step=6, tv_factor=0.2)
    assert relative_error(found.volume, scan[3]) < 0.5 * relative_error(less.volume, scan[3])


@pytest.mark.parametrize(
    ("best", "taken", "asked"), [(0.1, 0.1, 3), (0.17, 0.3, 2), (0.3, 0.3, 2), (0.9, 1.0, 2), (4.0, 3.0, 2)]
)
def test_less_is_tried_as_long_as_it_leaves_less(best, taken, asked):
    """Of a misfit that rises to both sides of the best weight; far less only where it leaves clearly less."""
    tries = _Tries(lambda factor: 1 + math.log(factor / best) ** 2)
    assert tries.choose([(0.3, 1.0), (0.1, 0.9), (0.05, 0.9)], more=True) == taken
    assert len(tries.left) == asked and tries.left[0.3] == pytest.approx(
        (1 + math.log(0.3 / best) ** 2) / (1 + math.log(best) ** 2)
    )


@pytest.mark.parametrize(
    ("changed", "because"),
    [
        ({"passes": 5}, "in so few passes"),
        ({"held_out": 0}, "no rays are held out"),
        ({"tv_weight": 0}, "nothing to smooth"),
    ],
)
def test_when_nothing_is_asked(changed, because):
    hasty = {"views_per_step": VIEWS} | changed  # the volume is nothing to them
    assert because in fitted(slice_of(FLAT, 0.05), **hasty).plan["tv_factor"].why


@pytest.mark.parametrize(
    ("discs", "noise", "size", "more"), [(FLAT, 0.05, 40, True), (RINGS, 0.005, SIZE, False)]
)
def test_a_slice_of_few_views_is_asked_as_well(discs, noise, size, more):
    scan = slice_of(discs, noise, views=30, size=size)
    found, other = (fitted(scan, views_per_step=3, tv_factor=k) for k in (None, 1 if more else 3))
    assert "misfit of the held-out rays" in found.plan["tv_factor"].why
    assert (found.plan["tv_factor"].value == 3) == more
    assert relative_error(found.volume, scan[3]) < 0.8 * relative_error(other.volume, scan[3])


def test_many_rays_a_voxel_need_no_more_smoothing():
    projections, proj_geom, vol_geom, _ = slice_of(FLAT, 0.05)
    coarse = vol_geom | {"GridRowCount": 32, "GridColCount": 32}
    told = fitted((projections, proj_geom, coarse), views_per_step=VIEWS).plan["tv_factor"]
    assert "3 rays a voxel" in told.why


def test_rings_that_explain_gains_are_no_reason_to_smooth_less():
    """Held-out rays have the gains of the others; what a fit misses otherwise counts as ever."""
    random = np.random.default_rng(0)
    gains, noise = random.normal(0, 0.1, (12, 15)), random.normal(0, 0.02, (40, 12, 15))
    turned = DetectorViews(False, np.zeros((40, 3)), np.broadcast_to(np.eye(3), (40, 3, 3)), 12, 15)
    values = torch.as_tensor((gains + noise).astype(np.float32))
    rays = Rays(values, turned, math.inf, 0.01, 0.2)
    gaussians = SimpleNamespace(attenuation=values.new_zeros(1))

    def missed(rings, uneven, wrong=0.0):
        """By a fit that has rings where the gains are, and is off otherwise by so much from view to view."""
        off = (
            rings * torch.as_tensor(gains, dtype=torch.float32)
            + wrong * torch.linspace(-1, 1, 40)[:, None, None]
        )
        numbers = iter([off[k : k + 8] for k in range(0, 40, 8)] * 2)
        scene = SimpleNamespace(projections=lambda *_: (next(numbers).expand(8, 12, 15), None))
        return _misfit_aside(gaussians, scene, rays, Settings(), 40, uneven)

    assert missed(1.0, False) < 0.5 * missed(0.0, False)
    assert missed(1.0, True) == pytest.approx(missed(0.0, True), rel=1e-3)
    assert missed(1.0, True) < missed(1.0, False)
    assert missed(1.0, True, wrong=0.1) > 2 * missed(1.0, True)

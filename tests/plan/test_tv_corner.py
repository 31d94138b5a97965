"""What counts as texture, and how much less of it is smoothed."""

import numpy as np
import pytest
import torch
from planned import ball, problem

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.kernels.compile_time import working_time
from tomo_polysplat.plan.decisions.tv_corner import bodies, corners_for, share_alike, tv_corners
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.order import decide_start
from tomo_polysplat.settings import Settings


def test_what_two_halves_agree_on_is_smoothed_less():
    """Soft and dense matter apart; not in small volumes, in homogeneous matter, nor where nothing can be told."""
    large, small = (40, 400, 500), (30, 30, 30)
    smooth = pytest.approx((0.1, 0.1))
    assert corners_for([None, None], large, 0.0) == corners_for([-0.4, -0.2], large, 0.0) == smooth
    assert corners_for([0.9, 0.9], small, 0.0) == corners_for([0.9, None], large, 0.8) == smooth
    soft, dense = corners_for([0.0, 0.9], large, 0.0)
    assert dense < 0.02 < soft == pytest.approx(0.1)
    alone = corners_for([0.15, None], large, 0.0)
    assert alone[0] == alone[1] and 0.02 < alone[0] < 0.1
    assert alone[0] < corners_for([0.15, None], (50, 50, 50), 0.0)[0] < 0.1
    assert alone[0] < corners_for([0.15, None], large, 0.7)[0] < 0.1
    in_a_slice = corners_for([0.15, 0.9], (1, 512, 500), 0.0)
    assert in_a_slice[0] < 0.1 and in_a_slice[1] == pytest.approx(0.1)


@pytest.mark.parametrize("light, share", [(1.0, 1.0), (0.5, 0.5), (0.01, 0.3)])
def test_light_matter_is_smoothed_by_smaller_differences(light, share):
    (soft, dense), _ = tv_corners(torch.ones(7, 9, 11), Settings(), lambda bodies: [None, None], light)
    assert soft == pytest.approx(0.1 * share) and dense == pytest.approx(0.1)


def test_thick_volumes_of_several_matters_are_smoothed_less_whatever_the_halves_say():
    thin, thick = (40, 400, 500), (200, 201, 203)
    noisy = corners_for([-0.1, 0.0], thick, 0.0)
    assert noisy[0] == pytest.approx(0.03, rel=0.05) and noisy[1] == pytest.approx(0.1)
    assert noisy[0] < corners_for([-0.1, 0.0], (96, 201, 203), 0.0)[0] < 0.1
    assert (
        corners_for([-0.1, 0.0], thin, 0.0)[0]
        == corners_for([-0.1, 0.0], thick, 0.8)[0]
        == pytest.approx(0.1)
    )
    assert corners_for([0.9, 0.0], thick, 0.0)[0] == pytest.approx(0.015), "texture is texture still"
    assert corners_for([None, None], thick, 0.0)[0] == pytest.approx(0.1), "nothing is told"


@pytest.mark.parametrize("shape", [(1, 61, 67), (15, 21, 23)])
def test_homogeneous_matter_is_alike_inside_and_textured_matter_is_not(shape):
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) if n > 1 else [0.0] for n in shape), indexing="ij")
    body = torch.from_numpy(x**2 + y**2 + z**2 < 0.9)
    rng = np.random.default_rng(5)
    blurred = torch.where(body, 1.0, 0.4)
    noise = torch.from_numpy(rng.normal(size=shape)).float()
    assert share_alike(blurred, body) == 1.0
    assert share_alike(blurred * (1 + 0.02 * noise), body) > 0.95
    assert share_alike(blurred * (1 + 0.3 * noise), body) < 0.3
    assert share_alike(blurred, body & (torch.from_numpy(x) > 0.8)) == 0.0, "too few to tell"


def test_matter_beside_metal_is_no_witness():
    relative = torch.zeros(1, 20, 30**3)
    relative[:, 4:16, 4:26] = 1.0
    relative[:, 8:12, 20:24] = 3.0
    relative[:, 9, 8] = 50.0
    soft, dense = bodies(relative, Settings())
    assert not soft[0, 9, 5:12].any() and bool(soft[0, 9, 12])
    assert int(dense.sum()) == 16 and not (soft & dense).any()


@pytest.mark.parametrize(("left", "made"), [(None, 1), (60.0, 1), (-1.0, 0)])
def test_halves_are_not_made_after_the_time_budget(monkeypatch, left, made):
    of, asked = problem(41), []
    monkeypatch.setattr(Problem, "agreement", lambda self, bodies: asked.append(1) or [0.9, None])
    end = None if left is None else working_time() + left
    lab = Lab(of, torch.as_tensor(ball(of, 1.0)), Settings(), torch.device("cpu"), end=end)
    decide_start(lab)
    assert len(asked) == made and ("do not tell" in lab.plan.answers["tv_corner"].why) == (not made)

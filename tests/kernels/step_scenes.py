"""A small fit to step through, and the comparison of two forms of the optimiser's step on it."""

import numpy as np
import torch
from splat_scenes import cone_views, gaussians, parallel_views, planar_views

from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.step import EagerStep, step_rates
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.physics.quadrature import Quadrature
from tomo_polysplat.settings import Settings

STEPS = 2
BATCH = 2
CURVES = torch.tensor([[1.0, 2.1, 6.0], [0.8, 1.5, 3.5]])


def fit_problem(kind, polychromatic, device, kernel, count=17, **changes):
    """What a fit is made of that has far to go."""
    views, planar = {
        "cone": (cone_views, False),
        "parallel": (parallel_views, False),
        "fan": (planar_views, True),
    }[kind]
    views = views(True, 5, 41) if planar else views(5, 7, 13, pixel=(0.32, 0.4))
    generator = torch.Generator().manual_seed(3)
    values = 1.5 * torch.rand((5, views.rows, views.columns), generator=generator) - 0.1
    values[1, 0, 3:6] = float("nan")
    values[:, -1, 7] = 400.0
    blurring, one_curve = changes.pop("blurring", True), changes.pop("one_curve", False)
    corners, every = changes.pop("corners", (0.1, 0.03)), changes.pop("every", 1)
    pixel_rays, filtered = changes.pop("pixel_rays", 1), changes.pop("filtered", False)
    settings = Settings(**({"held_out": 0.2, "tv_weight": 0.3, "material_from": 0.5} | changes))
    dimmed, behind = None, None
    if filtered:
        # A bowtie, and its P alone by the nodes and by the spectrum, which need not be the same.
        filters = 0.1 + torch.linspace(-1, 1, views.columns).square().expand(views.rows, -1)
        dimmed, behind = (0.8 * filters).to(device), torch.stack([filters, 0.7 * filters]).to(device)
    rays = Rays(values.to(device), views, 1e3, settings.model_error, settings.held_out, None, dimmed)
    quadrature, curves = None, (None, None)
    if polychromatic:
        weights = np.log([0.2, 0.5, 0.3])
        attenuation = CURVES.T.double().numpy() @ np.ones((2, 3)) * [3.0, 1.0, 0.4]
        by_node = np.array([2.0, 0.9, 0.3]) if filtered else None
        quadrature = Quadrature(weights, attenuation[:1] if one_curve else attenuation, 0, 0, 0, 5, by_node)
        curves = (None, None) if one_curve else CURVES.to(device)
    shape = (1, 7, 9) if planar else (4, 5, 6)
    box = VoxelBox(np.array([-0.6, -0.5, 0.0 if planar else -0.4]), np.array([0.2, 0.21, 0.23]), shape)
    scene = FitScene(
        box,
        quadrature,
        0.7,
        *curves,
        -0.1,
        kernel,
        0.0,
        blurring,
        corners,
        False,
        every,
        0.2,
        pixel_rays,
        behind=behind if polychromatic else None,
    )
    return FitSetup(_gaussians(count, planar, device), 0.2, rays, scene, settings)


def _gaussians(count, planar, device):
    position, scale, rotation, weight = (t.float() for t in gaussians(count, size=0.15, planar=planar))
    parts = [
        position,
        scale[:, : 2 if planar else 3].log(),
        rotation,
        weight[0],
        0.5 * weight[1],
        torch.tensor([0.0, 0.6, 0.7]),
        torch.arange(count) % 4 - 1,
        torch.tensor([0.2]),
    ]
    return Gaussians(*(t.contiguous().to(device) for t in parts))


def compare_steps(make, device, truth, kind="cone", polychromatic=True, **changes):
    """Both forms, from the same start with the same views, must read and change the same.

    With ``faster`` by so many times in the last step; with ``steps`` only so many of the last ones, in which materials
    are fitted.
    """
    outcomes, faster, steps = [], changes.pop("faster", 1.0), changes.pop("steps", STEPS)
    for form, where, kernel in ((make, device, "triton"), (EagerStep, *truth)):
        # Few: Triton's interpreter takes a tenth of a second for each.
        problem = fit_problem(kind, polychromatic, where, kernel, count=9, **changes)
        gaussians = problem.gaussians
        before = gaussians.copy()
        step = form(problem) if form is EagerStep else form(problem, BATCH)
        for k in range(STEPS - steps, STEPS):
            if k == STEPS - 1 and faster != 1:
                rates = step_rates(problem.settings, problem.spacing)
                step.set_rates({name: faster * rate for name, rate in rates.items()})
            step(np.array([k, 4 - k]), k / STEPS)
        read = step.read()
        after = {k: t.detach().cpu() for k, t in gaussians.parameters().items()}
        moved = {k: t - before.parameters()[k].cpu() for k, t in after.items()}
        outcomes.append((read, moved, step.moments, step.pull.cpu(), step.done))
    (read, moved, moments, pull, done), (read_2, moved_2, moments_2, pull_2, done_2) = outcomes
    np.testing.assert_allclose(read, read_2, rtol=1e-4)
    assert done == done_2 == steps
    _same(pull, pull_2, 1e-3, "pull")
    for name, expected in moved_2.items():
        _same(moved[name], expected, 2e-2, name)
        for got, wanted in zip(moments[name], moments_2[name]):
            _same(got.cpu(), wanted.cpu(), 2e-3, f"moment of {name}")
    return moved


def _same(got, expected, tolerance, what):
    assert bool(torch.isfinite(got).all()), what
    error = float((got - expected).norm())
    assert error <= tolerance * float(expected.norm()), f"{what}: {error / float(expected.norm()):.1e}"

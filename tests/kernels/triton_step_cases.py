"""Steps of the optimiser by the Triton kernels against those by autograd."""

import functools
import inspect
import itertools
from unittest import mock

import numpy as np
import torch
from step_scenes import BATCH, compare_steps, fit_problem
from triton_case import case

from tomo_polysplat.fit.loss import away_from_edges, total_variation
from tomo_polysplat.fit.shares import Part, parted, planes_of_all
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.kernels import portions
from tomo_polysplat.model.gaussians import OF_ALL
from tomo_polysplat.ranks import Ranks


def _fused(problem, batch):
    from tomo_polysplat.fit.fused_step import FusedStep

    return FusedStep(problem, batch)


@functools.cache
def _usual_steps(device):
    return compare_steps(_fused, device, ("cpu", "reference"))


@case
def a_step_of_our_kernels_is_that_of_autograd(device):
    moved = _usual_steps(device)
    # Every kind of parameter moved, but for the held number of the soft matter.
    assert all(bool(t.any()) for t in moved.values()), moved
    assert float(moved["shared_material"][0]) == 0 != float(moved["shared_material"][1])


@case
def a_step_of_a_large_cloud_portion_by_portion(device):
    """With what is made of some Gaussians made twice, and kept of all; with a detector that blurs, and a sharp one."""
    with mock.patch.object(portions, "FOOTPRINTS", 8), mock.patch.object(portions, "_WHOLE", 4):
        with mock.patch("tomo_polysplat.fit.fused_step._kept", lambda *_: 1):
            compare_steps(_fused, device, ("cpu", "reference"), steps=1)
        compare_steps(_fused, device, ("cpu", "reference"), blurring=False, steps=1)


@case
def a_step_of_a_monochromatic_parallel_scan(device):
    moved = compare_steps(
        _fused, device, ("cpu", "reference"), "parallel", False, loss="weighted-l1", blurring=False, steps=1
    )
    assert not any(bool(moved[name].any()) for name in ("own_material", "shared_material", "blur"))


@case
def a_step_of_one_curve_under_a_spectrum(device):
    for kind, blurring in (("cone", True), ("parallel", False)):
        changes = {"blurring": blurring, "one_curve": True, "steps": 1}
        moved = compare_steps(_fused, device, ("cpu", "reference"), kind, **changes)
        assert bool(moved["attenuation"].any()) and bool(moved["blur"].any()) == blurring
        assert not any(bool(moved[name].any()) for name in ("own_material", "shared_material"))


@case
def smoothing_pulls_as_the_derivative_says(device):
    """On noise and on faint steps, beside an edge, dense matter and metal and away from them."""
    from tomo_polysplat.kernels.step.triton_variation import variation_gradient

    generator = torch.Generator().manual_seed(4)
    for shape, corners in (((9, 11, 7), (0.1, 0.03)), ((1, 7, 9), (0.1, 0.1)), ((3, 8, 8), (0.0, 0.0))):
        volume = 1 + 0.15 * torch.rand(shape, generator=generator)
        volume[:, -1], volume[0, 0, 0], volume[-1, 1, 1] = 0.2, 3.0, 9.0
        asked = volume.clone().requires_grad_()
        (0.3 * total_variation(asked, corners, 2.2)).backward()
        largest = torch.zeros(1, device=device)
        found = variation_gradient(volume[None].to(device), corners, 2.2, 0.3, largest, shape[0])
        np.testing.assert_allclose(found[0].cpu(), asked.grad, rtol=1e-4, atol=1e-8)
        away = away_from_edges(volume, corners[0], 2.2)
        assert bool(away.any()) == (corners[0] > 0) and not bool(away.all()), "a case of each"


@case
def a_step_in_two_dimensions(device):
    compare_steps(_fused, device, ("cpu", "reference"), "fan", material_from=2.0, corners=(0.0, 0.0), steps=1)


@case
def a_step_without_smoothing_held_out_rays_or_blur(device):
    compare_steps(_fused, device, ("cpu", "reference"), tv_weight=0.0, held_out=0.0, blurring=False, steps=1)


@case
def every_other_step_smooths_twice_as_much(device):
    compare_steps(_fused, device, ("cpu", "reference"), every=2)


@case
def a_step_at_other_rates_than_the_one_before(device):
    slow, fast = _usual_steps(device), compare_steps(_fused, device, ("cpu", "reference"), faster=3.0)
    for name in ("position", "attenuation", "blur"):
        assert float(fast[name].norm()) > 1.3 * float(slow[name].norm()), name


@case
def pixels_that_average_the_light_of_several_rays(device):
    """With metal's edges in them, under a spectrum and without, blurred and not, along both axes and along one."""
    for kind, polychromatic, changes in (
        ("cone", True, {}),
        ("cone", True, {"one_curve": True, "blurring": False}),
        ("parallel", False, {"blurring": False}),
        ("fan", True, {"pixel_rays": 3}),
    ):
        changes = {"pixel_rays": 2, "steps": 1} | changes
        compare_steps(_fused, device, ("cpu", "reference"), kind, polychromatic, **changes)


@case
def pixels_behind_a_filter_that_is_not_everywhere_as_thick(device):
    for kind, polychromatic, changes in (
        ("cone", True, {}),
        ("cone", True, {"blurring": False}),
        ("fan", True, {"one_curve": True, "pixel_rays": 2, "blurring": False}),
        ("parallel", False, {"blurring": False, "loss": "weighted-l1"}),
    ):
        changes = {"filtered": True, "steps": 1} | changes
        compare_steps(_fused, device, ("cpu", "reference"), kind, polychromatic, **changes)


@case
def the_slope_by_the_blur_behind_much_matter(device):
    """As large as the projections, and yet a sum of whole numbers."""
    slopes = []
    for where, kernel, form in (
        (device, "triton", _fused),
        ("cpu", "reference", lambda problem, _: EagerStep(problem)),
    ):
        problem = fit_problem("cone", True, where, kernel, held_out=0.0, loss="l1")
        problem.gaussians.blur.zero_()
        problem.gaussians.attenuation.mul_(60.0)
        step = form(problem, BATCH)
        step(np.array([0, 3]), 0.0)
        slopes.append(10 * float(step.moments["blur"][0]))
    assert abs(slopes[0] / slopes[1] - 1) < 1e-3 and abs(slopes[1]) > 0.1, slopes


@case
def what_is_not_a_number_shows_in_the_misfit(device):
    """Hidden, it would spread through the volume and never end the run."""
    for blurring, rays in ((True, 1), (False, 1), (True, 2)):
        problem = fit_problem(
            "cone", True, device, "triton", 9, blurring=blurring, pixel_rays=rays, held_out=0.0
        )
        step = _fused(problem, BATCH)
        problem.gaussians.attenuation[3] = float("nan")
        step(np.array([0, 3]), 0.0)
        assert np.isnan(step.read()[0]), (blurring, rays)


@case
def another_number_of_views_or_gaussians_is_no_other_kernel(device):
    """Triton compiles anew for what begins at 16 bytes or does not, and for some whole numbers."""
    if device != "cpu":
        return  # tests/fit/test_step.py counts what is compiled
    from triton.runtime import interpreter

    found: set[tuple] = set()
    with mock.patch.object(
        interpreter.InterpretedFunction, "run", lambda *a, **k: found.add(_special(*a, **k))
    ):
        for count, batch in ((17, 2), (16, 1), (33, 3), (32, 4)):
            before = set(found)
            for pixel_rays in (1, 2):
                problem = fit_problem("cone", True, device, "triton", count=count, pixel_rays=pixel_rays)
                _fused(problem, batch)(np.arange(batch), 0.0)
            assert not before or found == before, found - before
    assert len(found) > 10


def _special(kernel, *args, grid, warmup, **named):
    """What Triton makes a kernel for: of arguments their types, or their values where it looks at these."""
    from tomo_polysplat.kernels.triton_maths import SIZES

    told = [kernel.fn.__name__]
    parameters = inspect.signature(kernel.fn).parameters
    own = {name: value for name, value in named.items() if name in parameters}
    for name, value in inspect.signature(kernel.fn).bind(*args, **own).arguments.items():
        if "constexpr" in str(parameters[name].annotation) or value is None:
            told.append((name, str(value)))
        elif isinstance(value, torch.Tensor):
            told.append((name, value.dtype, value.data_ptr() % 16 == 0))
        else:
            looks = type(value) is int and name not in SIZES
            told.append((name, type(value), looks and (value == 1, value % 16 == 0)))
    return tuple(told)


@case
def the_parts_of_ranks_make_the_step_of_one(device):
    """Of three with few planes to part, and of two in a plane, which cannot be parted at all; by portions.

    The one has all at once, a third of the time; that its portions make the same is a case of its own.
    """
    for kind, count, changes in (
        ("cone", 3, {"pixel_rays": 2}),
        ("cone", 2, {"count": 16}),
        ("fan", 2, {"blurring": False}),
    ):
        whole = _stepped(kind, device, 1, changes)
        with mock.patch.object(portions, "FOOTPRINTS", 8), mock.patch.object(portions, "_WHOLE", 4):
            parts = _stepped(kind, device, count, changes)
        for name, values in whole.items():
            tolerance = 2e-5 * np.abs(values).max()
            np.testing.assert_allclose(parts[name], values, rtol=1e-4, atol=tolerance, err_msg=name)
            assert np.abs(values).max() > 0 or "blur" in name, name


def _stepped(kind, device, count, changes):
    """What a step of so many ranks, which take turns, makes of the optimiser's memory, and its misfit."""
    problem = fit_problem(kind, True, device, "triton", **({"count": 9} | changes))
    if count == 1:
        indices, steps = [torch.arange(len(problem.gaussians))], [_fused(problem, BATCH)]
    else:
        indices = parted(problem.gaussians, count)
        planes = planes_of_all(problem.gaussians, indices, problem.scene.box)
        steps = [_of_rank(problem, rank, index, planes) for rank, index in enumerate(indices)]
    for step in steps:
        step._control.copy_(torch.from_numpy(step._next(np.array([3, 1]), 0.6)))
    stages = [step._stages(0.3) for step in steps]
    for summands in itertools.zip_longest(*stages):
        for same in zip(*summands):
            total = sum(tensor.clone() for tensor in same)
            for tensor in same:
                tensor.copy_(total)
    found = {"misfit": steps[-1]._sums}
    for name in problem.gaussians.parameters():
        first = [step.moments[name][0] for step in steps]
        if name in OF_ALL:
            assert all(torch.equal(one, first[0]) for one in first)
        found[name] = first[0] if name in OF_ALL else torch.cat(first)[torch.cat(indices).argsort()]
    return {name: tensor.double().cpu().numpy() for name, tensor in found.items()}


def _of_rank(problem, rank, index, planes):
    from tomo_polysplat.fit.fused_step import FusedStep

    part = Part(Ranks(rank, len(planes)), planes[rank], problem.gaussians.position.device)
    own = problem.gaussians.select(index).copy()
    return FusedStep(problem._replace(gaussians=own), BATCH, part)

"""The forms of the optimiser's step: the same mathematics, whichever runs.

The kernels themselves are compared with autograd in tests/kernels, in Triton's interpreter too.
"""

import logging
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from tomo_polysplat.fit.choose_step import make_step, why_eager
from tomo_polysplat.fit.feed import StreamedFeed
from tomo_polysplat.fit.shares import Part, Planes
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.kernels import portions
from tomo_polysplat.ranks import ALONE

sys.path.append(str(Path(__file__).parents[1] / "kernels"))
from step_scenes import BATCH, compare_steps, fit_problem


def test_the_cpu_steps_through_autograd():
    problem = fit_problem("cone", True, "cpu", "numba")
    step = make_step(problem, batch=BATCH)
    assert isinstance(step, EagerStep)
    assert "numba" in why_eager(problem.scene, problem.settings)


def test_the_cpu_smooths_every_other_step_twice_as_much():
    ends = []
    for every, weights in ((2, (0.3, 0.3)), (1, (0.6, 0.0))):
        problem = fit_problem("cone", True, "cpu", "numba", tv_weight=0.3, every=every)
        step = EagerStep(problem)
        for k, weight in enumerate(weights):
            step.settings = replace(problem.settings, tv_weight=weight)
            step(np.array([k, 4 - k]), 0.0)
        ends.append(problem.gaussians.copy().parameters())
    for name in ends[0]:
        torch.testing.assert_close(ends[0][name], ends[1][name], msg=name)


def test_no_material_number_falls_below_what_the_curves_allow():
    problem = fit_problem("cone", True, "cpu", "numba")
    gaussians, scene = problem.gaussians, replace(problem.scene, least_u=-0.03)
    gaussians.own_material.fill_(-0.1)
    EagerStep(problem._replace(scene=scene))(np.array([0, 1]), 0.9)
    assert float(gaussians.own_material.detach().min()) == pytest.approx(-0.03)


def test_the_memory_of_a_step_can_be_put_back():
    """Two steps in one go, and with everything copied in between, end at the same bits."""
    ends = []
    for interrupted in (False, True):
        problem = fit_problem("cone", True, "cpu", "numba")
        step = EagerStep(problem)
        step(np.array([0, 1]), 0.0)
        if interrupted:
            problem = problem._replace(gaussians=problem.gaussians.copy())
            again = EagerStep(problem)
            for name, moments in again.moments.items():
                for new, old in zip(moments, step.moments[name]):
                    new.copy_(old)
            again.done = step.done
            step = again
        step(np.array([2, 3]), 0.7)
        ends.append(problem.gaussians.copy().parameters())
    assert all(torch.equal(ends[0][name], ends[1][name]) for name in ends[0])


def test_totals_are_the_weights_of_the_fitted_rays():
    rays = fit_problem("cone", True, "cpu", "numba").rays
    _, _, weight, _ = rays.batch(np.arange(5))
    torch.testing.assert_close(rays.totals, weight.sum(dim=(1, 2)))
    # 400 is more than float32's exponential holds.
    assert bool(torch.isfinite(weight).all())


def graph_step(problem, batch):
    from tomo_polysplat.fit.graph_step import GraphStep

    return GraphStep(problem, batch)


def test_gaussians_turn_from_the_second_step_on():
    """What would turn a round one in the first is rounding."""
    problem = fit_problem("cone", True, "cpu", "numba")
    gaussians = problem.gaussians
    before, step = gaussians.copy(), EagerStep(problem)
    step(np.array([0, 1]), 0.0)
    assert torch.equal(gaussians.rotation, before.rotation)
    assert not torch.equal(gaussians.position, before.position)
    step(np.array([2, 3]), 0.5)
    assert not torch.equal(gaussians.rotation, before.rotation)


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("kind", "polychromatic", "changes"),
    [
        ("cone", True, {}),
        ("parallel", False, {"loss": "weighted-l1"}),
        ("fan", True, {}),
        ("cone", True, {"tv_weight": 0.0, "held_out": 0.0}),
        ("cone", True, {"every": 2}),
        ("cone", True, {"pixel_rays": 2}),
        ("cone", True, {"faster": 3.0}),
    ],
)
def test_a_graph_steps_like_autograd(kind, polychromatic, changes):
    compare_steps(graph_step, "cuda", ("cuda", "triton"), kind, polychromatic, **changes)


def step_in_parts(problem, batch):
    """As of a rank that holds all Gaussians and shares all planes, with nobody."""
    from tomo_polysplat.fit.graph_step import GraphStep

    depth, device = problem.scene.box.shape[0], problem.gaussians.position.device
    part = Part(ALONE, Planes(slice(0, depth), np.arange(depth)), device)
    made = GraphStep(problem, batch, part)
    assert all(len(graphs) > 1 for graphs in made._graphs.values())
    return made


@pytest.mark.gpu
@pytest.mark.parametrize(
    ("kind", "polychromatic", "changes"),
    [
        ("cone", True, {"every": 2}),
        ("parallel", False, {"blurring": False}),
        ("fan", True, {"pixel_rays": 2}),
    ],
)
@pytest.mark.parametrize("kept", [None, 0, 1, 99])
def test_a_graph_in_parts_steps_like_autograd(kind, polychromatic, changes, kept, monkeypatch):
    """Also by portions of the Gaussians, with what is made of none, some or all of them kept."""
    if kept is not None:
        monkeypatch.setattr(portions, "FOOTPRINTS", 8)
        monkeypatch.setattr(portions, "_WHOLE", 4)
        monkeypatch.setattr("tomo_polysplat.fit.fused_step._kept", lambda _, many, *__: min(kept, many))
    compare_steps(step_in_parts, "cuda", ("cuda", "triton"), kind, polychromatic, **changes)


@pytest.mark.gpu
def test_streamed_views_are_those_asked_for_whatever_is_still_on_its_way():
    views, rng, found = torch.rand(7, 331, 413), np.random.default_rng(0), []
    feed = StreamedFeed(views, torch.device("cuda", 0), 3)
    for k in range(20):
        chosen = rng.permutation(7)[: 3 - k % 2]
        slots = feed.place(chosen)
        found.append((chosen, feed.projections[slots[0] : slots[-1] + 1].clone()))
        feed.used()
    assert all(torch.equal(placed.cpu(), views[chosen]) for chosen, placed in found)


@pytest.mark.gpu
def test_projections_on_the_host_give_the_same_steps():
    """Views streamed to the GPU step by step, against views that are there."""
    ends = []
    for streamed in (False, True):
        problem = fit_problem("cone", True, "cuda", "triton")
        if streamed:
            rays = problem.rays
            rays.device, rays.projections = torch.device("cuda", 0), rays.projections.cpu()
        step = graph_step(problem, BATCH)
        for k in range(9):
            step(np.array([k % 5, (k + 2) % 5]), 0.1 * k)
        ends.append((step.read(), problem.gaussians.position.cpu()))
    np.testing.assert_allclose(ends[0][0], ends[1][0], rtol=1e-5)
    torch.testing.assert_close(ends[0][1], ends[1][1], rtol=1e-4, atol=1e-5)


@pytest.mark.gpu
def test_another_number_of_views_or_gaussians_compiles_nothing(monkeypatch):
    """Which would take longer than many a pass over the views. (One view alone has registers of its own.)"""
    import triton

    compiled = []

    def note(**about):
        # torch has kernels of Triton's as well.
        if about["fn"].module.startswith("tomo_polysplat"):
            compiled.append(about["repr"])

    monkeypatch.setattr(triton.knobs.runtime, "jit_post_compile_hook", note)
    # Whatever ran before: without this some of the kernels, or all of them, are there already.
    for module in [m for name, m in sys.modules.items() if name.startswith("tomo_polysplat.kernels.")]:
        for kernel in vars(module).values():
            if isinstance(kernel, triton.runtime.JITFunction):
                kernel.device_caches.clear()
    found = []
    for count, batch in ((17, 2), (16, 4), (33, 3)):
        compiled.clear()
        problem = fit_problem("cone", True, "cuda", "triton", count=count)
        step = graph_step(problem, batch)
        step(np.arange(batch), 0.0)
        found.append(list(compiled))
    assert found[0] and found[1:] == [[], []]


@pytest.mark.gpu
def test_a_graph_that_cannot_be_recorded_is_said_and_replaced(monkeypatch, caplog):
    problem = fit_problem("cone", True, "cuda", "triton")
    before = problem.gaussians.copy()

    def refuse(*_, **__):
        raise RuntimeError("no graphs here")

    monkeypatch.setattr(torch.cuda.CUDAGraph, "capture_begin", refuse)
    with caplog.at_level(logging.WARNING):
        step = make_step(problem, batch=BATCH)
    assert isinstance(step, EagerStep) and "no graphs here" in caplog.text
    for name, tensor in problem.gaussians.parameters().items():
        assert torch.equal(tensor, before.parameters()[name]), name
    step(np.array([0, 1]), 0.0)
    assert np.isfinite(step.read()[0])


def stepped(step, turns):
    """Of steps made so: the last one's Gaussians and what they read."""
    for k in turns:
        step(np.array([k % 5, (k + 2) % 5]), 0.1 * k)
    return step.gaussians.copy(), step.read()


def assert_alike(one, other):
    np.testing.assert_allclose(one[1], other[1], rtol=1e-5)
    for name, tensor in one[0].parameters().items():
        torch.testing.assert_close(tensor, other[0].parameters()[name], rtol=1e-4, atol=1e-5, msg=name)


@pytest.mark.gpu
@pytest.mark.parametrize("every", [1, 2])
def test_runs_that_share_memory_step_as_if_alone(every):
    """One after the other, each twice; also when the first has gone, and a third one shares with the second."""

    def problem(rays):
        return fit_problem("cone", True, "cuda", "triton", every=every, pixel_rays=rays)

    alone = {rays: stepped(make_step(problem(rays), batch=BATCH), range(6)) for rays in (1, 2)}
    first = make_step(problem(1), batch=BATCH)
    second = make_step(problem(2), batch=BATCH, beside=first)
    assert second._pool == first._pool
    for step in (first, second):
        for k in range(3):
            step(np.array([k % 5, (k + 2) % 5]), 0.1 * k)
    assert_alike(stepped(first, range(3, 6)), alone[1])
    assert_alike(stepped(second, range(3, 6)), alone[2])
    del first
    torch.cuda.empty_cache()
    third = make_step(problem(1), batch=BATCH, beside=second)
    assert_alike(stepped(third, range(6)), alone[1])


@pytest.mark.gpu
@pytest.mark.parametrize("place", ["_of_rays", "_of_volume", "_update"])
def test_a_gpu_without_room_for_a_second_run_goes_on_with_the_first(place, monkeypatch):
    """Wherever in the recording it ends; torch can then give memory back and record again."""
    from tomo_polysplat.fit.choose_step import NoRoom
    from tomo_polysplat.fit.graph_step import GraphStep

    problem = fit_problem("cone", True, "cuda", "triton")
    alone = stepped(make_step(problem, batch=BATCH), range(6))
    first, do = (
        make_step(fit_problem("cone", True, "cuda", "triton"), batch=BATCH),
        getattr(GraphStep, place),
    )
    for k in range(3):
        first(np.array([k, (k + 2) % 5]), 0.1 * k)

    def full(step, *parts):
        made = do(step, *parts)
        if torch.cuda.is_current_stream_capturing():
            torch.empty(1 << 50, dtype=torch.uint8, device="cuda")
        return made

    with monkeypatch.context() as patch, pytest.raises(NoRoom):
        patch.setattr(GraphStep, place, full)
        make_step(fit_problem("cone", True, "cuda", "triton"), batch=BATCH, beside=first)
    torch.cuda.empty_cache()
    again = make_step(fit_problem("cone", True, "cuda", "triton"), batch=BATCH, beside=first)
    assert_alike(stepped(first, range(3, 6)), alone)
    assert_alike(stepped(again, range(6)), alone)


@pytest.mark.gpu
def test_a_recording_that_is_invalidated_leaves_torch_in_order():
    """Other steps are made in its place, and memory can be given back."""
    from tomo_polysplat.fit.graph_step import GraphStep

    with pytest.MonkeyPatch.context() as patch:
        do = GraphStep._update
        # To wait for a stream that is recorded is forbidden, and ends the recording.
        patch.setattr(GraphStep, "_update", lambda step, *made: (do(step, *made), made[0][0].cpu()))
        assert isinstance(make_step(fit_problem("cone", True, "cuda", "triton"), batch=BATCH), EagerStep)
    torch.cuda.empty_cache()
    assert isinstance(make_step(fit_problem("cone", True, "cuda", "triton"), batch=BATCH), GraphStep)

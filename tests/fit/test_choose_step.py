"""What a lack of memory on a GPU comes to while a step is made, and what two runs of one fit share; with fakes."""

import sys
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from tomo_polysplat.fit import choose_step, follow
from tomo_polysplat.fit.choose_step import NoRoom, own_step
from tomo_polysplat.fit.led_step import LedStep
from tomo_polysplat.fit.lent_rays import about_rays
from tomo_polysplat.fit.shares import parted, planes_of_all
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.ranks import Ranks

sys.path.append(str(Path(__file__).parents[1] / "kernels"))
from step_scenes import BATCH, fit_problem


@pytest.fixture
def problem():
    return fit_problem("cone", True, "cpu", "numba")


@pytest.fixture
def graphs(monkeypatch):
    """Has a graph recorded by what a test puts in its place."""
    fake = SimpleNamespace(GraphStep=None)
    monkeypatch.setitem(sys.modules, "tomo_polysplat.fit.graph_step", fake)
    monkeypatch.setattr(choose_step, "why_eager", lambda *_: "")
    return fake


class Recorded:
    """A graph that costs nothing."""

    def __init__(self, *parts):
        self.beside = parts[3]
        self.pull, self.moments = None, {}


def failing(first, then=None):
    class Failing:
        def __init__(self, *_):
            try:
                raise first
            finally:
                # As the end of a recording that was broken off.
                if then is not None:
                    raise then

    return Failing


FULL = torch.cuda.OutOfMemoryError("CUDA out of memory")


@pytest.mark.parametrize(
    "problems",
    [(FULL,), (FULL, RuntimeError("capture was invalidated")), (RuntimeError("CUDA error: out of memory"),)],
)
def test_no_room_for_a_graph_is_none_for_single_operations(problem, graphs, problems):
    graphs.GraphStep = failing(*problems)
    with pytest.raises(NoRoom) as told:
        own_step(problem, BATCH)
    assert told.value.__context__ is None, "which would hold all that was made"


def test_what_else_a_graph_fails_of_is_no_lack_of_memory(problem, graphs):
    graphs.GraphStep = failing(RuntimeError("no graphs here"))
    assert isinstance(own_step(problem, BATCH), EagerStep)


@pytest.mark.parametrize("mine", [Recorded, failing(FULL)])
def test_ranks_go_without_a_step_together(problem, graphs, mine):
    """That of one suffices, whichever it is."""
    graphs.GraphStep = mine
    ranks = Ranks(0, 2)
    ranks.total = lambda *numbers: [1.0]
    with pytest.raises(NoRoom):
        own_step(problem, BATCH, ranks)


class Told(Ranks):
    """Rank 0 of two, which tells nobody."""

    def __init__(self):
        super().__init__(0, 2)
        self.messages = []

    def tell(self, *message):
        self.messages.append(message)

    def send(self, tensors, rank=0):
        self.messages.append(("tensors", len(list(tensors)), rank))


def test_after_a_step_that_has_no_room_ranks_make_others(problem):
    ranks = Told()

    def make(*parts):
        if isinstance(parts[3], Recorded):
            raise NoRoom("full")
        return Recorded(*parts)

    first = LedStep(make, problem, BATCH, ranks)
    with pytest.raises(torch.cuda.OutOfMemoryError, match="full"):
        LedStep(make, problem, BATCH, ranks, first)
    assert ranks.usable
    LedStep(make, problem, BATCH, ranks)
    number = first._number
    made = [parts[-1]["beside"] for what, *parts in ranks.messages if what == "make"]
    assert made == [0, number, 0]


def test_a_rank_that_follows_shares_the_same_and_goes_on_without_a_step(problem, monkeypatch):
    gaussians, spacing, rays, scene, settings = problem
    asked = []
    parts = parted(gaussians, 2)
    parts = {
        "gaussians": gaussians.select(parts[0][:0]),
        "counts": [len(part) for part in parts],
        "planes": planes_of_all(gaussians, parts, scene.box),
        "spacing": spacing,
        "rays": about_rays(rays),
        "scene": scene,
        "settings": settings,
        "batch": BATCH,
    }

    def own(*given):
        asked.append(given[3])
        if len(asked) == 2:
            raise NoRoom("full")
        return Recorded(*given)

    monkeypatch.setattr(follow, "own_step", own)
    monkeypatch.setattr(follow, "kept_threads", nullcontext)
    messages = [
        ([], ("rays", 1, rays.projections)),
        *(
            ([], ("make", number, 1, parts | {"beside": beside}))
            for number, beside in ((2, 0), (3, 2), (4, 2))
        ),
        ([2], ("end",)),
    ]
    ranks = Ranks(1, 2)
    ranks.hear, ranks.receive = lambda: messages.pop(0), lambda tensors: [t.fill_(0) for t in tensors]
    follow.follow(ranks)
    assert asked[0] is None and isinstance(asked[1], Recorded) and asked[1] is asked[2]

"""The step of the optimiser as a CUDA graph: recorded once, replayed for every step."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.fused_step import FusedStep
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.shares import Part
from tomo_polysplat.fit.step import smoothing
from tomo_polysplat.free_memory import give_back, keeps_more_than, recording
from tomo_polysplat.model.gaussians import Gaussians

__all__ = ["GraphStep"]

# Steps that the host may be ahead of the device: enough to hide its work, few enough to keep a time budget.
_AHEAD = 4
# Of the device's memory, what torch may keep unused while a step is recorded.
_UNUSED = 0.02


def _give_back(device: torch.device) -> None:
    """Give back what torch keeps unused, if it is much.

    While a graph is recorded nothing can be given back, and no other graph can use what was kept for one.
    """
    if keeps_more_than(_UNUSED, device):
        give_back()


# Parts of a step in their order, and what ranks add up after each: nothing after the last.
_Recorded = list[tuple[torch.cuda.CUDAGraph, tuple[torch.Tensor, ...]]]


class GraphStep(FusedStep):
    """Replays of a recorded `FusedStep`, of one that smooths and of one that does not; see `fit.step.Step`.

    Where it cannot be recorded the error leaves the Gaussians as they were.

    Parameters
    ----------
    setup, batch, part
        As for `FusedStep`.
    beside : GraphStep, optional
        One of the same run, never replayed at the same time: both use the same memory for what a step makes on its way.
    """

    def __init__(
        self, setup: FitSetup, batch: int, part: Part | None = None, beside: GraphStep | None = None
    ) -> None:
        super().__init__(setup, batch, part)
        self._recording = True
        device = setup.gaussians.position.device
        self._side, self._forked = torch.cuda.Stream(device), False
        with torch.cuda.device(device):
            self._pool: Any = torch.cuda.graph_pool_handle() if beside is None else beside._pool
        self._waiting = [
            torch.zeros(len(self._control), dtype=torch.float64).pin_memory() for _ in range(_AHEAD)
        ]
        self._passed = [torch.cuda.Event() for _ in range(_AHEAD)]
        self._graphs = self._record(batch)
        self._recording = False

    def __call__(self, views: np.ndarray, share: float) -> None:
        """One step; see `Step`."""
        turn = self.done % _AHEAD
        self._passed[turn].synchronize()
        graphs = self._graphs[smoothing(self.settings, self.scene, self.done)]
        values = self._next(views, share)
        self._waiting[turn].numpy()[:] = values
        self._control.copy_(self._waiting[turn], non_blocking=True)
        for graph, summands in graphs:
            graph.replay()
            if summands:
                self._add_up(summands)
        # On another GPU than the current one, the usual stream would say nothing about this one's work.
        self._passed[turn].record(torch.cuda.current_stream(self._control.device))
        self.feed.used()

    def _record(self, batch: int) -> dict[float, _Recorded]:
        """Graphs by the weight they smooth with, after a trial run that compiles the kernels and leaves no trace."""
        before, device = self.gaussians.copy(), self.gaussians.position.device
        weights = {smoothing(self.settings, self.scene, step) for step in range(self.scene.tv_every)}
        with torch.no_grad(), torch.cuda.device(device):
            # The memory of graphs of earlier steps, and below that of the trial run.
            _give_back(device)
            try:
                super().__call__(np.arange(batch), 0.0)
                # Not the whole device: another thread may be recording on it.
                torch.cuda.current_stream().synchronize()
            finally:
                self._forget(before)
            _give_back(device)
            # As only one of the graphs runs at a time, they share what memory they need.
            stream = torch.cuda.Stream(device)
            return {smooth: self._recorded(smooth, stream) for smooth in weights}

    def _add_up(self, summands: tuple[torch.Tensor, ...]) -> None:
        # Ranks record at their own pace, and what they add up is no part of a graph.
        if not self._recording:
            super()._add_up(summands)

    def _recorded(self, smooth: float, stream: torch.cuda.Stream) -> _Recorded:
        """A step as one graph, or as several between which ranks add up what they have made."""
        stages = self._stages(smooth)
        graphs: _Recorded = []
        while not graphs or graphs[-1][1]:
            graphs.append(self._captured(lambda: next(stages, ()), stream))
        return graphs

    def _captured(
        self, make: Callable[[], Any], stream: torch.cuda.Stream
    ) -> tuple[torch.cuda.CUDAGraph, Any]:
        """A graph of what ``make`` enqueues, and what that returns.

        ``torch.cuda.graph`` would give back all memory that is kept for later, and pinned memory takes 20 ms to get
        again: more than the recording itself.
        """
        graph = torch.cuda.CUDAGraph()
        with recording, torch.cuda.stream(stream):
            torch.cuda.synchronize()
            try:
                graph.capture_begin(pool=self._pool, capture_error_mode="thread_local")
                try:
                    made = make()
                finally:
                    graph.capture_end()
            except BaseException:
                self._end_recording()
                raise
        return graph, made

    def _end_recording(self) -> None:
        """Tell torch's allocator that a recording has ended which could not be ended in order.

        It would give nothing back any more: ``torch.cuda.empty_cache`` would be an error in this process from now on.
        """
        # One that has ended in order, or never began, is refused by the first of the two.
        with suppress(RuntimeError, AttributeError):
            device = torch.cuda.current_device()
            torch._C._cuda_endAllocateToPool(device, self._pool)
            torch._C._cuda_releasePool(device, self._pool)

    def _forget(self, before: Gaussians) -> None:
        for name, tensor in self.gaussians.parameters().items():
            tensor.copy_(before.parameters()[name])
        for tensor in (self._sums, self._skipped, self.pull, *sum(self.moments.values(), ())):
            tensor.zero_()
        self.done = self._unread = 0

    def _stages(self, smooth: float) -> Iterator[tuple[torch.Tensor, ...]]:
        try:
            yield from super()._stages(smooth)
        except BaseException:
            # A recording ends with an error of its own, which would hide this one, where its streams stay apart.
            self._join()
            raise

    @contextmanager
    def _beside(self) -> Iterator[None]:
        """On another stream: the rays' part and the volume's each leave much of a GPU idle."""
        self._side.wait_stream(torch.cuda.current_stream())
        self._forked = True
        with torch.cuda.stream(self._side):
            yield

    def _join(self) -> None:
        if self._forked:
            torch.cuda.current_stream().wait_stream(self._side)
            self._forked = False

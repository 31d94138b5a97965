"""The step of the optimiser as one CUDA graph: recorded once, replayed for every step."""

from __future__ import annotations

import threading

import numpy as np
import torch

from tomo_polysplat.fit.fused_step import FusedStep
from tomo_polysplat.fit.rays import Rays
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["GraphStep"]

# Steps that the host may be ahead of the device: enough to hide its work, few enough to keep a time budget.
_AHEAD = 4
# CUDA graphs of one process can be recorded only one after the other.
_recording = threading.Lock()


class GraphStep(FusedStep):
    """Replays of a recorded `FusedStep`; see `fit.step.Step`.

    Where it cannot be recorded the error leaves the Gaussians as they were.
    """

    def __init__(
        self,
        gaussians: Gaussians,
        spacing: float,
        rays: Rays,
        scene: FitScene,
        settings: Settings,
        batch: int,
        box: VoxelBox,
    ) -> None:
        super().__init__(gaussians, spacing, rays, scene, settings, batch)
        self._box = box.shape
        self._side = torch.cuda.Stream(gaussians.position.device)
        self._waiting = [
            torch.zeros(len(self._control), dtype=torch.float64).pin_memory() for _ in range(_AHEAD)
        ]
        self._passed = [torch.cuda.Event() for _ in range(_AHEAD)]
        self._graph = self._record(batch, box)

    def __call__(self, views: np.ndarray, box: VoxelBox, share: float) -> None:
        """One step; see `Step`."""
        turn = self.done % _AHEAD
        self._passed[turn].synchronize()
        values = self._next(views, box, share)
        self._waiting[turn].numpy()[:] = values
        self._control.copy_(self._waiting[turn], non_blocking=True)
        self._graph.replay()
        # On another GPU than the current one, the usual stream would say nothing about this one's work.
        self._passed[turn].record(torch.cuda.current_stream(self._control.device))
        self.feed.used()

    def _record(self, batch: int, box: VoxelBox) -> torch.cuda.CUDAGraph:
        """The graph, after a trial run that compiles the kernels and leaves no trace."""
        before, device = self.gaussians.copy(), self.gaussians.position.device
        with torch.no_grad(), torch.cuda.device(device):
            try:
                super().__call__(np.arange(batch), box, 0.0)
                torch.cuda.synchronize()
            finally:
                self._forget(before)
            graph = torch.cuda.CUDAGraph()
            # Torch's own stream for it belongs to whichever GPU came first in the process.
            stream = torch.cuda.Stream(device)
            with _recording, torch.cuda.graph(graph, stream=stream, capture_error_mode="thread_local"):
                self._enqueue()
        return graph

    def _forget(self, before: Gaussians) -> None:
        for name, tensor in self.gaussians.parameters().items():
            tensor.copy_(before.parameters()[name])
        for tensor in (self._sums, self._skipped, self.pull, *sum(self.moments.values(), ())):
            tensor.zero_()
        self.done = self._unread = 0

    def _box_gradients(self, position, scale, rotation, output, table) -> tuple[torch.Tensor, ...]:
        """Beside those of the rays: each alone leaves much of a GPU idle."""
        self._side.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(self._side):
            return super()._box_gradients(position, scale, rotation, output, table)

    def _join(self) -> None:
        torch.cuda.current_stream().wait_stream(self._side)

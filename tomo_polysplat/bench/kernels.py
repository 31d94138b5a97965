"""How many pixel-Gaussian pairs a second the projection and its adjoint do, once they are seen to be right."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch

from tomo_polysplat.kernels.project import autograd
from tomo_polysplat.kernels.project.reference import whitening_matrices
from tomo_polysplat.kernels.select import choose
from tomo_polysplat.kernels.spatial_order import spatial_order
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.parallel import cpu_threads

__all__ = ["CASES", "Case", "as_text", "bench_kernels"]

CUTOFF = 3.0
_RUNS = 10
IMAGE_TOLERANCE, GRADIENT_TOLERANCE = 1e-4, 1e-3  # relative L2 distance from the float64 reference


@dataclass(frozen=True)
class Case:
    """Gaussians of a typical ``size``, in half-widths of the scene, on square detectors of ``pixels`` a side."""

    gaussians: int
    size: float
    pixels: int
    views: int


CASES = {
    "cpu": (
        Case(100_000, 0.008, 192, 4),
        Case(100_000, 0.014, 192, 4),
        Case(100_000, 0.012, 512, 2),
        Case(20_000, 0.03, 512, 2),
    ),
    "cuda": (
        # About as many pairs in each of the first four, in larger and smaller footprints.
        Case(200_000, 0.0175, 512, 1),
        Case(200_000, 0.0088, 512, 4),
        Case(200_000, 0.0062, 512, 8),
        Case(50_000, 0.0125, 512, 8),
        Case(400_000, 0.0035, 512, 8),
        Case(1_000_000, 0.005, 1024, 4),
    ),
}

Scene = tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]


def bench_kernels(
    device: str = "cpu",
    *,
    kernel: str = "auto",
    cases: Sequence[Case] | None = None,
    channels: int = 3,
    repeats: int = 5,
) -> list[dict[str, Any]]:
    """Time the projection and its gradients, through torch's autograd, of Gaussians in the order of a fit.

    On a GPU each of the two is recorded as a CUDA graph, as a fit's steps are, and its replays are timed.

    Parameters
    ----------
    device : {"cpu", "cuda"}
    kernel : str
        One of ``kernels.select.KERNELS`` or "auto".
    cases : sequence of Case, optional
        ``None`` stands for ``CASES[device]``.
    channels : int
        Images made at once; 3 in a polychromatic fit.
    repeats : int
        The shortest of so many runs counts, after one that is not timed.

    Returns
    -------
    list of dict
        One JSON-able record a case: the case, ``kernel``, ``device``, ``threads``, ``pairs`` (pixels in the
        3-sigma ellipses, summed over Gaussians and views), ``pairs_per_footprint``, ``image_error`` and
        ``gradient_error`` (relative, of a smaller scene against the float64 reference), ``correct``,
        ``forward_seconds``, ``backward_seconds``, ``forward_pairs_per_second``, ``backward_pairs_per_second``
        (all four ``None`` where the kernel is not correct), and ``compile_seconds``, by which the first run of all
        was longer than the second (little where the compiler's output was cached).

    Raises
    ------
    ValueError
        If the kernel is unknown or cannot run on the device.
    """
    target = torch.device(device)
    chosen = CASES[target.type] if cases is None else cases
    started = time.perf_counter()
    kernel, _ = choose(target, kernel)
    _errors(chosen[0], kernel, target, channels)
    first = time.perf_counter() - started
    compile_seconds = max(0.0, first - _wall_seconds(lambda: _errors(chosen[0], kernel, target, channels)))
    records = [_bench(case, kernel, target, channels, repeats) for case in chosen]
    return [{**record, "compile_seconds": compile_seconds} for record in records]


def _bench(case: Case, kernel: str, device: torch.device, channels: int, repeats: int) -> dict[str, Any]:
    image_error, gradient_error = _errors(case, kernel, device, channels)
    correct = image_error < IMAGE_TOLERANCE and gradient_error < GRADIENT_TOLERANCE
    views, scene = _views(case), _scene(case, case.gaussians, channels)
    order = spatial_order(scene[0])
    scene = (scene[0][order], scene[1][order], scene[2][order], scene[3][:, order])
    pairs = _pairs(scene, views)
    record: dict[str, Any] = {
        **vars(case),
        "kernel": kernel,
        "device": device.type,
        "channels": channels,
        "threads": cpu_threads() if device.type == "cpu" else None,
        "pairs": pairs,
        "pairs_per_footprint": pairs / (case.gaussians * case.views),
        "image_error": image_error,
        "gradient_error": gradient_error,
        "correct": correct,
        "forward_seconds": None,
        "backward_seconds": None,
        "forward_pairs_per_second": None,
        "backward_pairs_per_second": None,
    }
    if not correct:
        return record
    with _stream(device):
        steps = _operations(scene, views, kernel, device)
        seconds = []
        for step in steps:
            ready = _ready(step, device, kernel)
            seconds.append(min(_seconds(ready, device) for _ in range(repeats)))
    for name, value in zip(("forward", "backward"), seconds, strict=True):
        record[f"{name}_seconds"] = value
        record[f"{name}_pairs_per_second"] = pairs / value
    return record


def _operations(
    scene: Scene, views: DetectorViews, kernel: str, device: torch.device
) -> tuple[Callable[[], torch.Tensor], Callable[[], Any]]:
    """The two steps to time, each without arguments."""
    leaves = [t.to(device, torch.float32).requires_grad_() for t in scene]

    def forward() -> torch.Tensor:
        position, scale, rotation, weight = leaves
        return autograd.project(position, scale, rotation, weight, views, kernel=kernel, cutoff=CUTOFF)[0]

    image = forward()
    cotangent = torch.rand(image.shape, generator=torch.Generator().manual_seed(1)).to(device)

    def backward() -> Any:
        return torch.autograd.grad(image, leaves, cotangent, retain_graph=True)

    return forward, backward


def _stream(device: torch.device):
    """Context in which everything runs on one stream that can be recorded; the default one cannot."""
    return torch.cuda.stream(torch.cuda.Stream(device)) if device.type == "cuda" else contextlib.nullcontext()


def _ready(step: Callable[[], Any], device: torch.device, kernel: str) -> Callable[[], Any]:
    """The step once it has run, with our kernels on a GPU as the replay of a recording."""
    step()
    if device.type == "cpu" or kernel != "triton":
        return step
    graph = torch.cuda.CUDAGraph()
    torch.cuda.synchronize()
    with torch.cuda.graph(graph, stream=torch.cuda.current_stream()):
        step()
    graph.replay()
    return graph.replay


def _seconds(step: Callable[[], Any], device: torch.device) -> float:
    """On a GPU between two events in its own queue, over some runs, as the first waits for its launch."""
    if device.type == "cpu":
        return _wall_seconds(step)
    start, stop = (torch.cuda.Event(enable_timing=True) for _ in range(2))
    start.record()
    for _ in range(_RUNS):
        step()
    stop.record()
    stop.synchronize()
    return start.elapsed_time(stop) / 1000 / _RUNS


def _wall_seconds(step: Callable[[], Any]) -> float:
    started = time.perf_counter()
    step()
    return time.perf_counter() - started


def _errors(case: Case, kernel: str, device: torch.device, channels: int) -> tuple[float, float]:
    """Relative L2 distance of the image, and of the worst gradient, for a few Gaussians of the same footprint."""
    part = Case(40, case.size * case.pixels / 67, 67, 2)
    views, scene = _views(part), _scene(part, 40, channels)
    outcomes = []
    for name, where, dtype in (("reference", "cpu", torch.float64), (kernel, device, torch.float32)):
        position, scale, rotation, weight = (t.to(where, dtype).requires_grad_() for t in scene)
        leaves = (position, scale, rotation, weight)
        image, _ = autograd.project(*leaves, views, kernel=name, cutoff=CUTOFF)
        cotangent = torch.randn(image.shape, generator=torch.Generator().manual_seed(2))
        gradients = torch.autograd.grad(image, leaves, cotangent.to(image))
        outcomes.append([t.detach().cpu().double() for t in (image, *gradients)])
    errors = [float((got - truth).norm() / truth.norm()) for truth, got in zip(*outcomes, strict=True)]
    return errors[0], max(errors[1:])


def _scene(case: Case, count: int, channels: int) -> Scene:
    """Float32 Gaussians of axes 0.5 to 1.5 times the size, anywhere in a cube that the detector covers."""
    generator = torch.Generator().manual_seed(0)
    return (
        (torch.rand((count, 3), generator=generator) * 2 - 1) * 0.8,
        case.size * (0.5 + torch.rand((count, 3), generator=generator)),
        torch.randn((count, 4), generator=generator),
        torch.rand((channels, count), generator=generator),
    )


def _views(case: Case) -> DetectorViews:
    """A circular cone-beam orbit of radius 5, the detector 2 behind the axis and 4.3 wide."""
    pixel = 4.3 / case.pixels
    origins, matrices = [], []
    for angle in np.linspace(0, 2 * np.pi, case.views, endpoint=False) + 0.3:
        ahead = np.array([-np.sin(angle), np.cos(angle), 0.0])
        u, v = pixel * np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.0, 0.0, pixel])
        origins.append(-5.0 * ahead)
        matrices.append(np.stack([u, v, 7.0 * ahead - (u + v) * (case.pixels - 1) / 2], axis=1))
    return DetectorViews(True, np.array(origins), np.array(matrices), case.pixels, case.pixels)


def _pairs(scene: Scene, views: DetectorViews) -> float:
    """Area in pixels of the ellipses within ``CUTOFF``: pi cutoff^2 |e|^2 / |nu x nv| at the centre (README)."""
    position, scale, rotation = (t.double() for t in scene[:3])
    whiten = whitening_matrices(scale, rotation)
    total = 0.0
    for origin, matrix, inverse in zip(views.origin, views.matrix, views.inverse, strict=True):
        ray = position - torch.as_tensor(origin)
        depth = ray @ torch.as_tensor(inverse[2])
        w = torch.einsum("nab,nb->na", whiten, ray)
        nu, nv = (torch.linalg.cross(w, whiten @ torch.as_tensor(matrix[:, k])) for k in (0, 1))
        spread = torch.linalg.cross(nu, nv).norm(dim=1) * depth.square()
        total += float((w.square().sum(dim=1) / spread).sum()) * math.pi * CUTOFF**2
    return total


def as_text(records: Sequence[dict[str, Any]]) -> str:
    """The records as a table for a terminal; a kernel that is wrong shows its error in place of a speed."""
    form = "{:>10} {:>6} {:>6} {:>14} {:>16} {:>16}"
    lines = [
        form.format("Gaussians", "pixels", "views", "px/footprint", "forward pairs/s", "backward pairs/s")
    ]
    for record in records:
        speeds = ["WRONG", f"by {max(record['image_error'], record['gradient_error']):.0e}"]
        if record["correct"]:
            speeds = [f"{record[f'{name}_pairs_per_second']:.2e}" for name in ("forward", "backward")]
        size = [str(record[key]) for key in ("gaussians", "pixels", "views")]
        lines.append(form.format(*size, f"{record['pairs_per_footprint']:.1f}", *speeds))
    kernels = sorted({f"{record['kernel']} on {record['device']}" for record in records})
    compile_seconds = max((record["compile_seconds"] for record in records), default=0.0)
    lines.append(f"{', '.join(kernels)}; compiling took {compile_seconds:.1f} s, not counted")
    return "\n".join(lines)

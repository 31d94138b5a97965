"""Gaussians of extreme shape, place, density and number: the float32 kernel against the float64 reference."""

from __future__ import annotations

import math

import numpy as np
import torch

from tomo_polysplat.bench.hard_cases.case import Case, Findings
from tomo_polysplat.kernels.project.autograd import project
from tomo_polysplat.kernels.select import choose
from tomo_polysplat.kernels.views import DetectorViews

__all__ = ["CASES", "compare_precisions"]

Scene = list[torch.Tensor]
_NAMES = ("position", "scale", "rotation", "weight")
IMAGE, GRADIENT = 1e-5, 1e-4


def views_of(count: int = 3, pixels: int = 41, width: float = 4.3, distance: float = 5.0) -> DetectorViews:
    """A circular cone beam on a square detector 2 behind the axis."""
    pixel = width / pixels
    origins, matrices = [], []
    for angle in np.linspace(0, 2 * np.pi, count, endpoint=False) + 0.3:
        ahead = np.array([-np.sin(angle), np.cos(angle), 0.0])
        u, v = pixel * np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.0, 0.0, pixel])
        origins.append(-distance * ahead)
        matrices.append(np.stack([u, v, (distance + 2) * ahead - (u + v) * (pixels - 1) / 2], axis=1))
    return DetectorViews(True, np.array(origins), np.array(matrices), pixels, pixels)


def random_gaussians(count: int, size: float = 0.1) -> Scene:
    """Position, scale, rotation and weight (3 channels) in float64, holding numbers of float32."""
    generator = torch.Generator().manual_seed(0)
    scene = [
        (torch.rand((count, 3), generator=generator) * 2 - 1) * 0.9,
        size * (0.5 + torch.rand((count, 3), generator=generator)),
        torch.randn((count, 4), generator=generator),
        torch.rand((3, count), generator=generator),
    ]
    return [part.double() for part in scene]


def _run(scene: Scene, views: DetectorViews, kernel: str, device: str, cutoff: float) -> tuple[Scene, int]:
    dtype = torch.float64 if kernel == "reference" else torch.float32
    leaves = [part.to(device, dtype).requires_grad_() for part in scene]
    position, scale, rotation, weight = leaves
    image, skipped = project(position, scale, rotation, weight, views, kernel=kernel, cutoff=cutoff)
    cotangent = torch.randn(image.shape, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    gradients = torch.autograd.grad(image, leaves, cotangent.to(image))
    return [part.detach().cpu().double() for part in (image, *gradients)], int(skipped)


# One parameter for each option that a caller names.
def compare_precisions(
    findings: Findings,
    scene: Scene,
    views: DetectorViews,
    device: str,
    *,
    image: float = IMAGE,
    gradient: float = GRADIENT,
    cutoff: float = 3.0,
) -> int:
    """Relative L2 distances of image and gradients; returns the pairs skipped, which must be the same."""
    kernel, _ = choose(torch.device(device))
    truth, expected = _run(scene, views, "reference", "cpu", cutoff)
    got, skipped = _run(scene, views, kernel, device, cutoff)
    for name, one, other in zip(("image", *_NAMES), got, truth):
        norm = float(other.norm())
        what = "error of the image" if name == "image" else f"error of the {name}'s gradient"
        distance = float((one - other).norm()) / (norm or 1.0)
        findings.at_most(what, distance, image if name == "image" else gradient)
    findings.equal("pairs skipped", skipped, expected)
    return skipped


def _ordinary(device: str) -> Findings:
    findings = Findings()
    compare_precisions(findings, random_gaussians(200), views_of(), device)
    return findings


def _aspect(shape: list[float], device: str) -> Findings:
    """A hundredth of a pixel thin: rounding a pixel coordinate in float32 moves it by 5e-4 of its width."""
    scene = random_gaussians(200)
    scene[1] = torch.tensor(shape, dtype=torch.float32).double().expand(200, 3)
    findings = Findings()
    # Cut where the step is small, so that a pixel on the edge, in one image and not in the other, is no matter.
    compare_precisions(findings, scene, views_of(), device, image=5e-4, gradient=5e-3, cutoff=4.5)
    return findings


def _needle(device: str) -> Findings:
    return _aspect([1.0, 1e-3, 1e-3], device)


def _pancake(device: str) -> Findings:
    return _aspect([1.0, 1.0, 1e-3], device)


def _behind(device: str) -> Findings:
    """Round a source among them: those behind it and across its plane are left out, and counted."""
    scene = random_gaussians(300, 0.15)
    scene[0] = scene[0] * 2
    findings = Findings()
    skipped = compare_precisions(findings, scene, views_of(distance=1.0), device, image=1e-4, gradient=1e-3)
    findings.at_least("pairs skipped", skipped, 100)
    return findings


def _densities(device: str) -> Findings:
    """Densities of 0 and 1e6 side by side: the image is linear in them, so errors are relative to 1e6."""
    scene = random_gaussians(200)
    scene[3] = torch.where(torch.arange(200) % 2 == 0, 0.0, 1e6).double().expand(3, 200).contiguous()
    findings = Findings()
    compare_precisions(findings, scene, views_of(), device)
    return findings


def _crowd(device: str) -> Findings:
    """A million on one pixel: float32 sums are off by n eps / 2 at the worst, 3 %, and by chance by sqrt(n) eps."""
    count = 1_000_000
    scene = random_gaussians(count, 0.02)
    scene[0] = scene[0] * 1e-3
    findings = Findings()
    worst = count * float(np.finfo(np.float32).eps) / 2
    compare_precisions(findings, scene, views_of(1, 1, 0.1), device, image=worst)
    return findings


def _closed_form(device: str) -> Findings:
    """One round Gaussian seen along its middle: sqrt(2 pi) sigma."""
    kernel, _ = choose(torch.device(device))
    scene = random_gaussians(1)
    scene[0], scene[1] = torch.zeros(1, 3).double(), torch.full((1, 3), 0.125).double()
    image = _run(scene, views_of(1, 41), kernel, device, 3.0)[0][0]
    true = scene[3][:, 0] * math.sqrt(2 * math.pi) * 0.125
    findings = Findings()
    error = float((image[:, 0, 20, 20] / true - 1).abs().max())
    findings.at_most("error of the middle pixel", error, IMAGE)
    return findings


CASES = (
    Case("gaussian-alone", "sqrt(2 pi) sigma along the middle, to float32", _closed_form),
    Case("gaussians-ordinary", "float32 to 1e-5 in the image and 1e-4 in every gradient", _ordinary),
    Case("needles", "aspect 1e3, a hundredth of a pixel thin: 5e-4 and 5e-3", _needle),
    Case("pancakes", "aspect 1e3, a hundredth of a pixel thin: 5e-4 and 5e-3", _pancake),
    Case(
        "behind-the-source",
        "left out and counted as by the reference; 1e-4 and 1e-3 near the source",
        _behind,
    ),
    Case("densities", "0 and 1e6 side by side: 1e-5 and 1e-4", _densities),
    Case("million-on-a-pixel", "a float32 sum: n eps / 2 in the image, 1e-4 in every gradient", _crowd),
)

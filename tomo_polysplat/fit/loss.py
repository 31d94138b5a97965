"""What the fit minimises: the misfit of the rays and the roughness of the volume."""

from __future__ import annotations

import math
from typing import Any

import torch

from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.fit.shares import Part
from tomo_polysplat.kernels.device import is_for_compiled
from tomo_polysplat.kernels.step.faint import BESIDE, EDGE, FAINT
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = [
    "away_from_edges",
    "huber_width",
    "losses",
    "misfit",
    "misfit_by_view",
    "misfits_of_step",
    "pull_of_roughness",
    "slope_of_variation",
    "total_variation",
    "variation_of_slab",
]


# Axes of (views, rows, columns) that a mean is over, where each view has its own.
_OF_VIEW = (1, 2)


def misfit(
    predicted: torch.Tensor,
    measured: torch.Tensor,
    weight: torch.Tensor,
    settings: Settings,
    dims: tuple[int, ...] | None = None,
) -> torch.Tensor:
    """The loss of the rays that the settings name: the mean over all, or over the axes ``dims``."""
    return losses(predicted, measured, weight, settings).sum(dims) / weight.sum(dims).clamp(min=1e-12)


def losses(
    predicted: torch.Tensor, measured: torch.Tensor, weight: torch.Tensor, settings: Settings
) -> torch.Tensor:
    """That of each ray times its weight; `misfit` is their sum over that of the weights, 0 when every weight is 0.

    ``w |p - m|``, or Huber's function (1964, doi:10.1214/aoms/1177703732), which counts residuals squared where noise
    explains them and absolute beyond, with its corner at the same multiple of each ray's deviation.
    """
    scaled, width = (predicted - measured).abs() * weight, huber_width(settings)
    if not width:
        return scaled
    return torch.where(scaled < width, scaled.square() / (2 * width), scaled - 0.5 * width)


def huber_width(settings: Settings) -> float:
    """Residual times weight from which on a ray counts absolute; 0 where all do."""
    return settings.huber_corner * settings.model_error if settings.loss == "huber" else 0.0


def misfits_of_step(
    predicted: torch.Tensor,
    measured: torch.Tensor,
    weight: torch.Tensor,
    aside: torch.Tensor,
    settings: Settings,
) -> tuple[torch.Tensor, torch.Tensor | float, torch.Tensor | float]:
    """`misfit` of the fitted rays, differentiable; that of those held ``aside``, times their weight, and this."""
    if is_for_compiled(predicted):
        return _Misfits.apply(predicted, measured, weight, aside, huber_width(settings))
    fitted = misfit(predicted, measured, weight, settings)
    with torch.no_grad():
        total = aside.sum()
        return fitted, misfit(predicted, measured, aside, settings) * total, total


class _Misfits(torch.autograd.Function):
    """The mean misfit of the fitted rays, and of those held out the sum and their weight, with slopes of the first."""

    @staticmethod
    def forward(
        ctx: Any,
        predicted: torch.Tensor,
        measured: torch.Tensor,
        weight: torch.Tensor,
        aside: torch.Tensor,
        width: float,
    ) -> tuple[torch.Tensor, float, float]:
        from tomo_polysplat.kernels.step.numba_misfit import misfit_sums

        (loss, total, held_out, total_aside), slopes = misfit_sums(
            (predicted, measured, weight, aside), width
        )
        ctx.total = max(float(total), 1e-12)
        ctx.save_for_backward(slopes)
        return predicted.new_tensor(loss / ctx.total), float(held_out), float(total_aside)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor, *_: None) -> tuple[torch.Tensor | None, ...]:
        (slopes,) = ctx.saved_tensors
        return slopes * (gradient / ctx.total), None, None, None, None


def misfit_by_view(
    predicted: torch.Tensor, measured: torch.Tensor, weight: torch.Tensor, settings: Settings
) -> torch.Tensor:
    """(views,) that of each view of (views, rows, columns); NaN where no ray of a view has weight."""
    means = misfit(predicted, measured, weight, settings, _OF_VIEW)
    return torch.where(weight.amax(_OF_VIEW) > 0, means, torch.nan)


def pull_of_roughness(
    gaussians: Gaussians, scene: FitScene, settings: Settings, weight: float, part: Part | None = None
) -> torch.Tensor:
    """A zero whose slope is ``weight`` times that of the volume's total variation: all that a step needs of it.

    With a rank's ``part`` of the fit, that of its planes in the sum over ranks.
    """
    volume = scene.attenuation(gaussians, scene.box if part is None else part.box(scene.box))
    volume = volume if part is None else part.volume_of_all(volume)
    chosen = scene.box.shape[0], scene.tv_corners, settings.bone_level
    return _Pull.apply(volume, slope_of_variation(volume.detach(), *chosen, weight))


class _Pull(torch.autograd.Function):
    """Nothing, with a slope that is known."""

    @staticmethod
    def forward(ctx: Any, volume: torch.Tensor, slope: torch.Tensor) -> torch.Tensor:
        ctx.save_for_backward(slope)
        return volume.new_zeros(())

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor, None]:
        (slope,) = ctx.saved_tensors
        return slope * gradient, None


def slope_of_variation(
    slab: torch.Tensor, planes: int, corners: tuple[float, float], dense: float, factor: float
) -> torch.Tensor:
    """``factor`` times the slope of `variation_of_slab`, (nz, ny, nx)."""
    if not is_for_compiled(slab):
        with torch.enable_grad():
            slab = slab.detach().requires_grad_()
            return torch.autograd.grad(factor * variation_of_slab(slab, planes, corners, dense), slab)[0]
    from tomo_polysplat.kernels.step.numba_variation import variation_gradient

    return variation_gradient(slab, _away(slab, planes, corners, dense), corners, dense, factor, planes)


def total_variation(
    volume: torch.Tensor,
    corners: tuple[float, float] = (0.0, 0.0),
    dense: float = math.inf,
) -> torch.Tensor:
    """Mean absolute difference of neighbouring voxels per axis, summed over the axes.

    With a ``corner`` c each difference d counts as ``c log(1 + |d| / c)``: like |d| below c, hardly more with every
    doubling above. So noise is smoothed as before, and edges and texture pay little for their height (the log-sum
    penalty: Candes, Wakin and Boyd 2008, doi:10.1007/s00041-008-9045-x).

    A total variation takes from an inclusion what its surface is over its volume, however faint it is (Strong and Chan
    2003, doi:10.1088/0266-5611/19/6/059). So `away_from_edges` |d| is Huber's function of d, squared up to `FAINT` c;
    of a volume, not of a slice.

    Parameters
    ----------
    volume : (nz, ny, nx) tensor
        Axes of length one contribute nothing.
    corners : pair of float
        Of matter up to ``dense``, and where one of two neighbours is above it; both 0 for the total variation itself.
    dense : float
        In the unit of the volume.
    """
    return variation_of_slab(volume, len(volume), corners, dense)


def variation_of_slab(
    slab: torch.Tensor,
    planes: int,
    corners: tuple[float, float] = (0.0, 0.0),
    dense: float = math.inf,
) -> torch.Tensor:
    """What a slab (nz, ny, nx) adds to the `total_variation` of a volume of so many ``planes``.

    Its slope is that of the whole, except within ``faint.HALO`` planes of where the slab ends and the volume does not.
    """
    whole = (planes, *slab.shape[1:])
    away = _away(slab, planes, corners, dense)
    total = slab.new_zeros(())
    for axis, length in enumerate(whole):
        if length > 1:
            heights = _Heights.apply(slab, away, axis, corners, dense)
            total = total + heights / (math.prod(whole) // length * (length - 1))
    return total


def _away(slab: torch.Tensor, planes: int, corners: tuple[float, float], dense: float) -> torch.Tensor | None:
    """`away_from_edges` of a volume of several planes. In a slice, of few rays a voxel, streaks are faint, too."""
    return away_from_edges(slab, corners[0], dense) if any(corners) and planes > 1 else None


@torch.no_grad()
def away_from_edges(volume: torch.Tensor, corner: float, dense: float) -> torch.Tensor:
    """Which voxels have no edge and no dense matter beside them, within three voxels along each axis.

    Parameters
    ----------
    volume : (nz, ny, nx) tensor
    corner : float
        An edge varies by three of these at least.
    dense : float
        What is above it is dense.

    Returns
    -------
    (nz, ny, nx) bool tensor
    """
    if is_for_compiled(volume):
        from tomo_polysplat.kernels.step import numba_away

        return numba_away.away_from_edges(volume, corner, dense)
    most, least = volume, -volume
    for axis in range(volume.ndim):
        most, least = _largest_beside(most, axis), _largest_beside(least, axis)
    return (most + least < EDGE * corner) & (most <= dense)


def _largest_beside(volume: torch.Tensor, axis: int) -> torch.Tensor:
    """Largest value up to `BESIDE` voxels before and behind along an axis."""
    largest, length = volume.clone(), volume.shape[axis]
    for far in range(1, min(BESIDE, length - 1) + 1):
        before, behind = (volume.narrow(axis, start, length - far) for start in (0, far))
        for at, other in ((far, before), (0, behind)):
            part = largest.narrow(axis, at, length - far)
            torch.maximum(part, other, out=part)
    return largest


class _Heights(torch.autograd.Function):
    """The sum of what the differences of neighbours along an axis count; ``away`` is None where none is faint.

    Their slopes are found with it: autograd would go over the volume twice as often, and keep most of what it made.
    """

    @staticmethod
    def forward(
        ctx: Any,
        slab: torch.Tensor,
        away: torch.Tensor | None,
        axis: int,
        corners: tuple[float, float],
        dense: float,
    ) -> torch.Tensor:
        step = slab.diff(dim=axis)
        height, ctx.axis = step.abs(), axis
        slope = step.sign_()
        if any(corners):
            length = slab.shape[axis] - 1
            if away is not None and (width := FAINT * corners[0]):
                # Huber's function of d is d - width / 2 (1 - missing^2), and its slope 1 - missing.
                both = (away.narrow(axis, 0, length) & away.narrow(axis, 1, length)).to(height.dtype)
                missing = (height * (-1 / width)).add_(1).clamp_(min=0).mul_(both)
                height += missing.square().sub_(both).mul_(0.5 * width)
                slope *= missing.neg_().add_(1)
            corner = _corner(slab, axis, corners, dense)
            height /= corner
            slope /= height + 1
            height = height.log1p_().mul_(corner)
        ctx.save_for_backward(slope)
        return height.sum()

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        (slope,) = ctx.saved_tensors
        axis, shape = ctx.axis, list(slope.shape)
        pull = slope * gradient
        shape[axis] = 1
        end = pull.new_zeros(shape)
        # Each difference pulls its second voxel up and its first down.
        return torch.cat([end, pull], dim=axis) - torch.cat([pull, end], dim=axis), None, None, None, None


def _corner(
    slab: torch.Tensor, axis: int, corners: tuple[float, float], dense: float
) -> torch.Tensor | float:
    """The corner of each difference along an axis."""
    if corners[0] == corners[1]:
        return corners[0]
    length = slab.shape[axis] - 1
    either = torch.maximum(slab.narrow(axis, 0, length), slab.narrow(axis, 1, length)) > dense
    return torch.where(either, slab.new_tensor(corners[1]), slab.new_tensor(corners[0]))

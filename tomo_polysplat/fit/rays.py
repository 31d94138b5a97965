"""The measured rays on the solver's device: values, weights, and those held out of the fit."""

from __future__ import annotations

import functools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.kernels.device import is_for_compiled
from tomo_polysplat.kernels.views import DetectorViews
from tomo_polysplat.scan.noise import RayNoise, Values

__all__ = ["Rays", "batches_around", "views_around"]

# Rays whose weights are added up at once.
_CHUNK = 1 << 22
# Views that tell a fit's misfit, and those looked at together.
_VIEWS, _AT_ONCE = 24, 8


@dataclass
class Rays:
    """Projections with the views they belong to.

    Parameters
    ----------
    projections : (views, rows, columns) float32 tensor
        -log(I/I0); NaN where a ray is not to be used.
    views : DetectorViews
        In the solver's coordinates.
    photons : float
        Photons of an unattenuated ray; infinity weighs all rays alike.
    model_error : float
        Error of P that the model itself is allowed, which keeps quiet rays from outweighing the rest; with the noise
        that is as strong in every ray, if there is such.
    held_out : float
        Share of the rays kept from the fit.
    device : torch.device, optional
        Where batches go, for projections that stay on the host because they do not fit there.
    dimmed : (rows, columns) tensor, optional
        -log of the share of the beam that reaches each pixel through its filter: as many fewer photons.
    deviation : float
        Of the noise that is as strong in every ray.
    """

    projections: torch.Tensor
    views: DetectorViews
    photons: float
    model_error: float
    held_out: float
    device: torch.device | None = None
    dimmed: torch.Tensor | None = None
    deviation: float = 0.0

    @property
    def target(self) -> torch.device:
        """Where batches go."""
        return self.projections.device if self.device is None else self.device

    @property
    def noise(self) -> float:
        """Variance of an unattenuated ray over that of the model's error."""
        allowed = self.photons * self.model_error**2
        return 1 / allowed if allowed else float("inf")

    def variance(self, depth: Values) -> Values:
        """Of the noise of rays with this -log(I/I0)."""
        return RayNoise(self.photons, self.deviation).variance(depth)

    @property
    def threshold(self) -> int:
        """How many of 65536 rays are held out."""
        return int(self.held_out * 65536)

    def batch(self, chosen: np.ndarray) -> tuple[DetectorViews, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Views, values (0 where unusable), fit weights and held-out weights of the chosen views.

        The variance of -log(I/I0) is exp(P)/I0 for Poisson counts, to which that of the model is added; the
        weight is the inverse deviation, 1 for a ray without noise.
        """
        values, aside = _chosen(self.projections, chosen).to(self.target), self.aside(chosen)
        if is_for_compiled(values):
            from tomo_polysplat.kernels.step.numba_misfit import weigh

            return self.views.select(chosen), *weigh(values, aside, self.noise, self.dimmed)
        usable = torch.isfinite(values)
        values = torch.where(usable, values, torch.zeros_like(values))
        weight = usable.to(values.dtype)
        if self.noise:
            depth = values if self.dimmed is None else values + self.dimmed
            weight = weight * torch.rsqrt(1 + torch.exp(depth) * self.noise)
        return self.views.select(chosen), values, weight * ~aside, weight * aside

    @functools.cached_property
    def totals(self) -> torch.Tensor:
        """(views,) weight of the fitted rays of each view."""
        return self._added_up()

    def weigh_anew(self) -> None:
        """Bring `totals` up to date in place, where recorded steps read them, after values were changed in place."""
        if "totals" in self.__dict__:
            self.totals.copy_(self._added_up())
        self.__dict__.pop("typical_weight", None)

    def _added_up(self) -> torch.Tensor:
        sums, many = [], max(1, _CHUNK // (self.views.rows * self.views.columns))
        for first in range(0, len(self.views), many):
            _, _, weight, _ = self.batch(np.arange(first, min(first + many, len(self.views))))
            sums.append(weight.sum(dim=(1, 2)))
        return torch.cat(sums)

    @functools.cached_property
    def typical_weight(self) -> float:
        """Mean weight of a ray."""
        pixels = len(self.views) * self.views.rows * self.views.columns
        return float(self.totals.sum()) / max(pixels, 1) / (1 - self.held_out)

    def aside(self, chosen: np.ndarray) -> torch.Tensor:
        """(n, rows, columns) rays held out: a fixed pseudo-random choice that needs no memory."""
        device, shape = self.target, self.projections.shape[1:]
        if not self.held_out:
            return torch.zeros((len(chosen), *shape), dtype=torch.bool, device=device)
        # One round of a multiplicative hash (Knuth) over the pair, to 16 even bits.
        if device.type == "cpu":
            return torch.from_numpy(_hashed(shape, chosen) < self.threshold)
        pixel = torch.arange(shape.numel(), device=device, dtype=torch.int64).reshape(shape) * 2654435761
        view = _chosen(torch.arange(int(chosen.max(initial=-1)) + 1, device=device), chosen)[:, None, None]
        mixed = (pixel + (view * 40503 + 12345)) & 0xFFFFFFFF
        mixed = ((mixed ^ (mixed >> 15)) * 2246822519) & 0xFFFFFFFF
        return (mixed >> 16) < self.threshold


def _hashed(shape: torch.Size, views: np.ndarray) -> np.ndarray:
    """(n, rows, columns) the hash of `Rays.aside`, in whole numbers that drop what goes beyond 32 bits."""
    pixel = np.arange(shape.numel(), dtype=np.uint32).reshape(shape) * np.uint32(2654435761)
    view = views.astype(np.uint32) * np.uint32(40503) + np.uint32(12345)
    mixed = pixel + view[:, None, None]
    mixed ^= mixed >> np.uint32(15)
    mixed *= np.uint32(2246822519)
    mixed >>= np.uint32(16)
    return mixed


def _chosen(tensor: torch.Tensor, chosen: np.ndarray) -> torch.Tensor:
    """Those along the first axis. An index tensor would have to travel to a GPU, which waits for it."""
    if len(chosen) and (np.diff(chosen) == 1).all():
        return tensor[chosen[0] : chosen[-1] + 1]
    if tensor.device.type == "cpu":
        return tensor[torch.from_numpy(chosen)]
    return torch.stack([tensor[k] for k in chosen.tolist()])


def views_around(rays: Rays, most: int = _VIEWS) -> int:
    """How many views `batches_around` gives in all."""
    return min(most, len(rays.views))


def batches_around(
    rays: Rays, most: int = _VIEWS
) -> Iterator[tuple[DetectorViews, torch.Tensor, torch.Tensor, torch.Tensor]]:
    """What `Rays.batch` gives for so many of the views at most, evenly spread over the scan."""
    views = evenly_spread(len(rays.views), most)
    for first in range(0, len(views), _AT_ONCE):
        yield rays.batch(views[first : first + _AT_ONCE])

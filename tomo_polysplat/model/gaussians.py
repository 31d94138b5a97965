"""The unknowns: a cloud of Gaussians with an attenuation and a material number each.

Coordinates are relative to the volume's centre in units of half its longest side. A Gaussian has an attenuation at one
reference energy, in units of the scan's soft reference, and no density. So a change of the material number hardly
changes what most rays see, and both can be fitted at once.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import torch

from tomo_polysplat.kernels.device import is_for_compiled
from tomo_polysplat.transfer import copied

__all__ = ["OF_ALL", "Gaussians", "shares_of_curves"]

# Parameters that belong to no single Gaussian.
OF_ALL = ("shared_material", "blur")


@dataclass
class Gaussians:
    """Parameters of n Gaussians.

    Parameters
    ----------
    position : (n, 3) tensor
    log_scale : (n, 3) tensor
        Natural logarithm of the standard deviations; (n, 2) for the endless Gaussians of a planar scan.
    rotation : (n, 4) tensor
        Quaternions (w, x, y, z) of any length.
    attenuation : (n,) tensor
        At the centre and the reference energy, not negative.
    own_material : (n,) tensor
        Material number u of the Gaussians that have one to themselves.
    shared_material : (groups,) tensor
        Material number of each group.
    group : (n,) int64 tensor
        The group whose material number a Gaussian shares, or -1 for its own. The rays cannot tell the number of each
        Gaussian in the plastic around a pin, for example, but they tell one number for all of it very well.
    blur : (1,) tensor
        Variance in squared pixels of the detector's blur, which acts on their projections.
    """

    position: torch.Tensor
    log_scale: torch.Tensor
    rotation: torch.Tensor
    attenuation: torch.Tensor
    own_material: torch.Tensor
    shared_material: torch.Tensor
    group: torch.Tensor
    blur: torch.Tensor

    def __len__(self) -> int:
        return len(self.position)

    def parameters(self) -> dict[str, torch.Tensor]:
        """What is fitted, by name."""
        return {field.name: getattr(self, field.name) for field in fields(self) if field.name != "group"}

    def finite(self) -> bool:
        """Whether every parameter is finite. Rays do not show all that are not."""
        return all(bool(torch.isfinite(tensor).all()) for tensor in self.parameters().values())

    def copy(self) -> Gaussians:
        """Detached copies of everything."""
        return self.to(self.position.device)

    def to(self, device: torch.device) -> Gaussians:
        """Detached copies of everything on a device."""
        parts = {field.name: getattr(self, field.name) for field in fields(self)}
        return Gaussians(**{name: copied(tensor.detach(), device) for name, tensor in parts.items()})

    def kept(self, before: Gaussians | None) -> Gaussians:
        """Detached copies of everything on the host, in place of those made ``before`` where there are as many."""
        if self.position.device.type == "cpu":
            return self.copy()
        if before is None or len(before) != len(self):
            tensors = {field.name: getattr(self, field.name) for field in fields(self)}
            before = Gaussians(
                **{name: torch.empty(t.shape, dtype=t.dtype, pin_memory=True) for name, t in tensors.items()}
            )
        for field in fields(self):
            getattr(before, field.name).copy_(getattr(self, field.name).detach())
        return before

    def select(self, chosen: torch.Tensor) -> Gaussians:
        """The Gaussians of these (m,) int64 indices, still attached to the graph of gradients."""
        own = {name: tensor.index_select(0, chosen) for name, tensor in self.each().items()}
        return Gaussians(**own, **{name: getattr(self, name) for name in OF_ALL})

    def each(self) -> dict[str, torch.Tensor]:
        """What every Gaussian has of its own, by name."""
        return {f.name: getattr(self, f.name) for f in fields(self) if f.name not in OF_ALL}

    @property
    def planar(self) -> bool:
        """Whether they are two-dimensional."""
        return self.log_scale.shape[1] == 2

    def scale(self) -> torch.Tensor:
        """(n, 3) standard deviations; infinite along z when planar."""
        scale = self.log_scale.exp()
        if self.planar:
            scale = torch.cat([scale, scale.new_full((len(scale), 1), math.inf)], dim=1)
        return scale

    def material(self) -> torch.Tensor:
        """(n,) material numbers u."""
        # index_select, because the adjoint of indexing adds up equal indices one after the other.
        shared = self.shared_material.index_select(0, self.group.clamp(min=0))
        return torch.where(self.group < 0, self.own_material, shared)

    def weights(self, curve: torch.Tensor | None) -> torch.Tensor:
        """(3, n) densities of the soft, middle and dense curve, or the (1, n) attenuation without a curve.

        ``curve`` (3,) is the mass attenuation of the curves at the reference energy over that of the first.
        """
        if curve is None:
            return self.attenuation[None]
        if is_for_compiled(curve):
            return _Weights.apply(
                self.attenuation, self.own_material, self.shared_material, self.group, curve
            )
        u = self.material()
        mixture = shares_of_curves(u)
        return mixture * (self.attenuation / (curve @ mixture))


class _Weights(torch.autograd.Function):
    """`Gaussians.weights` on a CPU, where torch takes some thirty operations forth and back."""

    @staticmethod
    def forward(ctx: Any, *parts: torch.Tensor) -> torch.Tensor:
        from tomo_polysplat.kernels.step.numba_weights import weights

        ctx.parts = tuple(part.detach().contiguous().numpy() for part in parts)
        made, ctx.numbers = weights(ctx.parts)
        return torch.from_numpy(made[:, : len(parts[0])])

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, gradient: torch.Tensor) -> tuple[torch.Tensor | None, ...]:
        from tomo_polysplat.kernels.step.numba_weights import pull_weights

        pulled = pull_weights(ctx.parts, ctx.numbers, gradient.numpy())
        return *(torch.from_numpy(part) for part in pulled), None, None


def shares_of_curves(u: torch.Tensor) -> torch.Tensor:
    """(3, n) shares of the soft, middle and dense curve for material numbers (n,); sum 1."""
    return torch.stack([(1 - u).square(), 2 * u * (1 - u), u.square()])

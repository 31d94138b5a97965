"""A fit between two passes over the views, and who keeps it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from typing import Any, Protocol

import numpy as np
import torch

from tomo_polysplat.model.gaussians import Gaussians

__all__ = ["PARTS", "Keeps", "Snapshot"]

PARTS = tuple(field.name for field in fields(Gaussians))


@dataclass
class Snapshot:
    """A fit between two passes over the views.

    Attributes
    ----------
    gaussians, best : Gaussians
        As they are fitted, and as `Watch` keeps them; ``best`` is None before the first pass.
    first, second : dict of name to tensor
        Adam's moments of the fitted parameters.
    pull : (n,) tensor
        Lengths of the gradients of the positions since the last relocation.
    order : int array
        Views still to be used before any is used again.
    numbers : dict
        What JSON can hold: steps, clock, history, and the state of the random numbers.
    """

    gaussians: Gaussians
    best: Gaussians | None
    first: dict[str, torch.Tensor]
    second: dict[str, torch.Tensor]
    pull: torch.Tensor
    order: np.ndarray
    numbers: dict[str, Any]

    def arrays(self) -> dict[str, np.ndarray]:
        """Everything but the numbers, by its name in the file."""
        found: dict[str, Any] = {"pull": self.pull, "order": torch.as_tensor(self.order)}
        for kind, cloud in (("gaussians", self.gaussians), ("best", self.best)):
            if cloud is not None:
                found |= {f"{kind}/{name}": getattr(cloud, name) for name in PARTS}
        for kind, moments in (("first", self.first), ("second", self.second)):
            found |= {f"{kind}/{name}": tensor for name, tensor in moments.items()}
        return {name: tensor.detach().cpu().numpy() for name, tensor in found.items()}


class Keeps(Protocol):
    """What keeps a run, as a checkpoint does.

    Attributes
    ----------
    snapshot : Snapshot or None
        Where the run is to go on from.
    """

    snapshot: Snapshot | None

    def offer(self, make: Callable[[], Snapshot], *, now: bool) -> None:
        """Keep what ``make`` returns, unless that has only just been done; ``now`` keeps it in any case."""

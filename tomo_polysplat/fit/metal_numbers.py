"""The metals' material numbers that the rest of a fit starts from, from how dense they come out."""

from __future__ import annotations

import numpy as np
import torch

from tomo_polysplat.fit.metal_voxels import levels_of_pieces, metal_voxels
from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["number_metals"]

# Digits to which a number is rounded, as sums on a GPU repeat only to rounding.
_DIGITS = 3


@torch.no_grad()
def number_metals(gaussians: Gaussians, scene: FitScene, settings: Settings, share: float) -> None:
    """Give each piece of metal the number of the solid that is as dense, until numbers are fitted.

    The start volume does not tell which metal it is: there thick steel is as dark as titanium. After one pass over the
    views its attenuation is right to a few percent, while its number would not get from the one to the other in all of
    a run.

    Parameters
    ----------
    gaussians : Gaussians
        Changed in place.
    scene : FitScene
        Its ``solid_number`` tells the numbers; without it they stay.
    settings : Settings
        From ``material_from`` on nothing is done.
    share : float
        Of the run that is done.
    """
    if scene.solid_number is None or share >= settings.material_from:
        return
    members = (gaussians.group > 0).nonzero()[:, 0]
    if not len(members):
        return
    metal = gaussians.select(members)
    pieces, levels, _ = levels_of_pieces(metal, *metal_voxels(metal, scene))
    numbers = np.round(scene.solid_number(levels.cpu().numpy()), _DIGITS)
    shared = gaussians.shared_material
    shared[pieces] = torch.from_numpy(numbers).to(shared)

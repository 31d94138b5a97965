"""Material numbers that matter denser than soft matter starts from."""

from __future__ import annotations

import torch

from tomo_polysplat.settings import Settings

__all__ = ["start_numbers"]

# Attenuation of bone in soft references. At 90 kV cortical bone has 4.4, at 160 kV 2.4, at 60 kV 5.7.
_BONE = 4.0
# Attenuation, in soft references, up to which matter counts as soft: noise and streaks reach it.
_LEAST = 1.3


def start_numbers(relative: torch.Tensor, settings: Settings) -> torch.Tensor:
    """Material numbers by attenuation, as those of mixtures of soft matter and bone mineral go.

    Bone is such a mixture, and so is a voxel that an edge of bone crosses. Take water with a share ``f`` of
    hydroxyapatite by volume. The material number whose rays are most like its rays (``physics.best_stand_in``, default
    curves) is close to ``0.5 f / (f + 0.2)``. Its attenuation at 90 kV is ``v = 1 + 9.7 f`` times that of water. So the
    number is proportional to ``(v - 1) / (v + 1)``.

    Parameters
    ----------
    relative : tensor
        Attenuation in soft references.

    Returns
    -------
    tensor
        ``settings.bone_u`` at four soft references, and ``settings.soft_u`` up to 1.3 of them.
    """
    share = (relative - 1) / (relative + 1).clamp(min=1.0) * ((_BONE + 1) / (_BONE - 1))
    return settings.soft_u + torch.where(relative > _LEAST, share, 0.0) * (settings.bone_u - settings.soft_u)

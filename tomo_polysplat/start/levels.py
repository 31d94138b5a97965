"""How dense the main matter of a volume is."""

from __future__ import annotations

import numpy as np
import torch

__all__ = ["MAIN_SHARE", "main_level", "mass_level"]

# Of the mass that is no denser than so many times the level of half of it, the share below the main matter's
# attenuation. Too low a reference smooths too much (walls of a voxel, one energy: 20.8 dB with half the mass, 21.6).
_NOT_METAL, MAIN_SHARE = 3.0, 0.7
# That level is metal's where it is so many times that of the matter below a third of it, and voxels within the factor
# of this, with all their neighbours, are so many times as many as those above. Discs of 64^2 voxels with rods that hold
# 55 to 77 % of the mass came to 2.7 to 25 times, solids in noise, foams, needles and wires to less than 0.2, one
# in foam a twentieth as dense to 1.8; a start of few views has too many streaks to tell.
_FAR, _ALIKE, _MANY = 6.0, 1.5, 2.0
# Values looked at together: copies of so many are held, whatever the volume's size.
_AT_ONCE = 1 << 24
# A float32 above zero rises with its bits, of which so many are told at first and the rest in a second look.
_BITS = 16


def mass_level(volume: np.ndarray | torch.Tensor, share: float = 0.5) -> float:
    """The value below which a share of a volume's mass lies; half: its main matter, whatever noise and metal do.

    Of float32 values it is exact. No copy is made of more than a part of the volume: sorting all took 40 bytes a value.
    """
    values = torch.as_tensor(volume).reshape(-1)
    mass = _mass_of_bits(values, None).cumsum(0)
    wanted = share * mass[-1]
    if not wanted > 0:
        return 0.0
    high = int(torch.searchsorted(mass, wanted))
    wanted = wanted - mass[high - 1] if high else wanted
    within = _mass_of_bits(values, high)
    # Rounding may leave a little more to find than there is.
    low = min(int(torch.searchsorted(within.cumsum(0), wanted)), int(within.nonzero()[-1]))
    return float(torch.tensor((high << _BITS) + low, dtype=torch.int32).view(torch.float32))


def _mass_of_bits(values: torch.Tensor, high: int | None) -> torch.Tensor:
    """Sums of the values above zero by their first bits; or, of those whose first bits are ``high``, by the others."""
    sums = torch.zeros(1 << _BITS, dtype=torch.float64, device=values.device)
    for part in values.split(_AT_ONCE):
        part = part.float()
        part = part[part > 0]
        bits = part.view(torch.int32)
        first = bits >> _BITS
        if high is not None:
            chosen = first == high
            part, first = part[chosen], bits[chosen] & ((1 << _BITS) - 1)
        sums += torch.bincount(first, weights=part.double(), minlength=len(sums))
    # On the host: sums that a GPU runs over may fall by their rounding, and end at bits that no value has.
    return sums.cpu()


def main_level(volume: np.ndarray | torch.Tensor) -> float:
    """Attenuation of the main matter: above the level of half the mass where walls are too thin to show theirs.

    Metal may hold most of the mass: what most voxels are made of, and by far lighter, is the main matter then.
    """
    values = torch.as_tensor(volume)
    level = mass_level(values)
    if _is_metal(level, values):
        return main_level(torch.where(values <= level / _NOT_METAL, values, 0.0))
    return mass_level(torch.where(values <= _NOT_METAL * level, values, 0.0), MAIN_SHARE)


def _is_metal(level: float, values: torch.Tensor) -> bool:
    """Whether the level of half the mass is that of metal in lighter matter, which noise and streaks are not."""
    light = mass_level(torch.where(values <= level / _NOT_METAL, values, 0.0))
    if not 0 < _FAR * light < level:
        return False
    alike = (values > light / _ALIKE) & (values < light * _ALIKE) & (values <= level / _NOT_METAL)
    return int(_inner(alike).sum()) > _MANY * int((values > level / _NOT_METAL).sum())


def _inner(mask: torch.Tensor) -> torch.Tensor:
    """Voxels whose neighbours along every axis are in the mask as they are."""
    inner = mask.clone()
    for axis, length in enumerate(mask.shape):
        first, last = (mask.narrow(axis, k, length - 1) for k in (0, 1))
        inner.narrow(axis, 0, length - 1).logical_and_(last)
        inner.narrow(axis, 1, length - 1).logical_and_(first)
    return inner

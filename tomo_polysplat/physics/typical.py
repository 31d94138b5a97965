"""What typical rays through an object have, of all rays of a scan, without a copy of them."""

from __future__ import annotations

import math

import torch

__all__ = ["largest_finite", "typical_value"]

# Typical rays have more than this share of the largest value.
_INSIDE = 0.1
# Values looked at together, and bits that are told at once.
_CHUNK, _BITS = 1 << 22, 16
# So few are picked out, which takes less time than to count bits.
_FEW = 1 << 17


def largest_finite(values: torch.Tensor) -> torch.Tensor:
    """The largest finite value, minus infinity where there is none."""
    flat = values.reshape(-1)
    tops = [
        part.masked_fill(~torch.isfinite(part), -math.inf).max() for part in flat.split(_CHUNK) if len(part)
    ]
    return torch.stack(tops).max() if tops else flat.new_full((), -math.inf)


def typical_value(values: torch.Tensor) -> float | None:
    """The median of what is more than a tenth of the largest value; None where nothing is above zero.

    Of an even number the lower one of the two in the middle, as torch has it. Positive floats rise with their bits, of
    which some are told at a time. Picking the values out takes 40 bytes a ray.

    Parameters
    ----------
    values : tensor
        What is not finite does not count.
    """
    flat = values.reshape(-1)
    flat = flat if flat.dtype in (torch.float32, torch.float64) else flat.double()
    least = _INSIDE * largest_finite(flat).clamp(min=0)
    if len(flat) <= _FEW:
        inside = flat[(flat > least) & (flat < math.inf)]
        return float(inside.median()) if len(inside) else None
    whole = torch.int64 if flat.dtype == torch.float64 else torch.int32
    prefix, rank, first = 0, -1, 8 * flat.element_size() - _BITS
    for shift in range(first, -1, -_BITS):
        counts = torch.zeros(1 << _BITS, dtype=torch.int64, device=flat.device)
        for part in flat.split(_CHUNK):
            bits = part[(part > least) & (part < math.inf)].view(whole)
            if shift < first:
                bits = bits[bits >> (shift + _BITS) == prefix]
            counts += torch.bincount((bits >> shift) & ((1 << _BITS) - 1), minlength=1 << _BITS)
        sums = counts.cumsum(0).cpu()
        if rank < 0:
            if not int(sums[-1]):
                return None
            rank = (int(sums[-1]) - 1) // 2
        place = int(torch.searchsorted(sums, rank, right=True))
        rank -= int(sums[place - 1]) if place else 0
        prefix = prefix << _BITS | place
    return float(torch.tensor(prefix, dtype=whole).view(flat.dtype))

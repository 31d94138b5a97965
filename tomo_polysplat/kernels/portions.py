"""How many Gaussians have their footprints in a GPU's memory together."""

from __future__ import annotations

import math

__all__ = ["FOOTPRINTS", "portions"]

# So many footprints fill a GPU: more at once would only take memory.
FOOTPRINTS = 6 << 20
# Gaussians of a portion are a multiple of this: kernels take them by groups, and read four numbers at once.
_WHOLE = 64


def portions(gaussians: int, views: int) -> list[slice]:
    """So many Gaussians in their order, parted into some whose footprints in all these views are held together."""
    many = max(math.ceil(gaussians * views / FOOTPRINTS), 1)
    size = max(math.ceil(gaussians / many / _WHOLE), 1) * _WHOLE
    return [slice(first, min(first + size, gaussians)) for first in range(0, max(gaussians, 1), size)]

"""How much the light of a pixel and of one beside it may differ, for all kernels alike."""

__all__ = ["MOST_BESIDE"]

# A pixel has no more than exp of this times as much light as one beside it, as far as that matters to either.
MOST_BESIDE = 60.0

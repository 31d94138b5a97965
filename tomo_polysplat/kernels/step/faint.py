"""What counts as faint where a volume is smoothed, and what as away from edges; in corners of `fit.loss`."""

from __future__ import annotations

__all__ = ["BESIDE", "EDGE", "FAINT", "HALO"]

# Away from edges a difference up to this counts by its square.
FAINT = 0.5
# An edge varies by so many corners within so many voxels along each axis.
EDGE, BESIDE = 3.0, 3
# Planes that the slope of a voxel reads beyond its own.
HALO = BESIDE + 1

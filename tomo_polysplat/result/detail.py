"""How fine and how faint the detail of a result is, as `resolution` and `contrast` of ``quality`` have found."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

__all__ = ["Contrast", "Resolution", "ShellCorrelation"]


class ShellCorrelation(NamedTuple):
    """Correlation by spatial frequency.

    Attributes
    ----------
    frequency : (n,) array
        Middle of each shell, in cycles per unit of length, up to half a cycle a voxel.
    correlation : (n,) array
        -1 to 1; NaN where a shell holds next to nothing.
    """

    frequency: np.ndarray
    correlation: np.ndarray


@dataclass(frozen=True, eq=False)
class Resolution:
    """How fine the detail is that half the views and the other half show alike.

    Attributes
    ----------
    period : float
        Of the finest waves on which two halves of the views agree (correlation of 1/7), in `unit`. Detail of half a
        period is seen as such. Two voxels is the least that a volume can show.
    by_voxels : bool
        Whether the halves agree down to that.
    voxel : float
        Edge of a voxel.
    unit : str
    curve : ShellCorrelation
    doubt : (z, y, x) float32 array
        Standard deviation, in 1/`unit`, of the whole result that the difference of the halves tells, over about four
        voxels: large where halves disagree. What both have wrong, as beside metal, it does not tell.
    seconds : float
        That the two fits took.
    """

    period: float
    by_voxels: bool
    voxel: float
    unit: str
    curve: ShellCorrelation
    doubt: np.ndarray
    seconds: float

    def describe(self) -> str:
        """One sentence."""
        size = f"{self.period:.3g} {self.unit} ({self.period / self.voxel:.2g} voxels)"
        if self.by_voxels:
            return f"Two halves of the views agree on all that the voxels can show, waves of {size}."
        return (
            f"Two halves of the views agree on waves of {size} and longer (Fourier shell correlation of 1/7)."
        )


@dataclass(frozen=True, eq=False)
class Contrast:
    """Share of their contrast that faint balls keep.

    Attributes
    ----------
    diameters : (n,) array
        Of the balls, in `unit`.
    kept : (n,) array
        Mean share of their true contrast, in the volume with them less that without; NaN where no place was found.
    error : (n,) array
        Standard deviation of that mean, from how the balls of a size differ; NaN for a single one.
    added : float
        Their contrast, as a share of the attenuation of the object's main matter.
    voxel : float
        Edge of a voxel.
    unit : str
    seconds : float
        That the fit with them took.
    """

    diameters: np.ndarray
    kept: np.ndarray
    error: np.ndarray
    added: float
    voxel: float
    unit: str
    seconds: float

    def describe(self) -> str:
        """One sentence."""
        told = [
            f"{kept:.2f} of it at {diameter / self.voxel:.2g} voxels across"
            for diameter, kept in zip(self.diameters, self.kept)
            if np.isfinite(kept)
        ]
        if not told:
            return "The object has no place for a faint ball away from its surface and from metal."
        return f"A ball that differs by {self.added:.0%} from the matter around it keeps {', '.join(told)}."

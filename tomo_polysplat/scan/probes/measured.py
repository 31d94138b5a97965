"""What the probes look at, and what they answer."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

from tomo_polysplat.scan.defects import fill_invalid
from tomo_polysplat.scan.dropouts import dropped_rays
from tomo_polysplat.scan.geometry import Geometry, from_astra
from tomo_polysplat.scan.scan import Scan

__all__ = ["Finding", "Measured"]

# Rows and views that a probe of the whole scan looks at, evenly spread.
_MOST_ROWS = 32


@dataclass(frozen=True)
class Finding:
    """The answer of one probe.

    Attributes
    ----------
    probe : str
        What was looked for.
    verdict : {"ok", "defect", "unknown"}
        "unknown" where the scan cannot tell; the text says why.
    text : str
        What was found.
    remedy : str
        How to mend a defect.
    values : dict
        The numbers behind it.
    """

    probe: str
    verdict: str
    text: str
    remedy: str = ""
    values: dict[str, float] = field(default_factory=dict)

    @property
    def misleading(self) -> bool:
        """Whether it would mislead other probes: any defect but one of a few views."""
        return self.verdict == "defect" and self.values.get("misplaced", 1.0) > 0.1


@dataclass(frozen=True)
class Measured:
    """A scan with what several probes need of it, computed once."""

    scan: Scan
    dead_pixels: np.ndarray | None = None
    """Pixels not to look at, (rows, columns)."""

    @cached_property
    def geometry(self) -> Geometry:
        return from_astra(self.scan.proj_geom, self.scan.vol_geom)[0]

    @cached_property
    def valid(self) -> np.ndarray:
        """Rays that are marked good and finite, (rows, views, columns)."""
        good = np.isfinite(self.scan.projections)
        if self.scan.valid is not None:
            good &= self.scan.valid
        if self.dead_pixels is not None:
            good &= ~self.dead_pixels[:, None]
        return good

    @cached_property
    def filled(self) -> np.ndarray:
        """Some rows of the projections, at most 32, with bad rays interpolated, (rows, views, columns)."""
        rows = np.unique(
            np.linspace(0, self.scan.rows - 1, min(self.scan.rows, _MOST_ROWS)).round().astype(int)
        )
        values, valid = self.scan.projections[rows], self.valid[rows]
        return fill_invalid(values, valid & ~dropped_rays(np.where(valid, values, np.nan)))

    @cached_property
    def level(self) -> float:
        """What counts as large in this scan: the 99th percentile of its values."""
        return float(np.percentile(self.filled, 99))

    @cached_property
    def azimuth(self) -> np.ndarray:
        """Angle of the source, or of the beam, about z in radians, per view."""
        geometry = self.geometry
        origin = geometry.origin if geometry.beam == "parallel" else geometry.origin - self.axis
        return np.arctan2(origin[:, 1], origin[:, 0])

    @cached_property
    def axis(self) -> np.ndarray:
        """A point (x, y, z) of the rotation axis: the centre of the sources' circle, or the origin."""
        if self.geometry.beam == "parallel":
            return np.zeros(3)
        # |p|^2 = 2 c.p + (r^2 - |c|^2), in coordinates about the mean.
        mean = self.geometry.origin.mean(axis=0)
        local = (self.geometry.origin - mean)[:, :2]
        system = np.column_stack([2 * local, np.ones(len(local))])
        solution = np.linalg.lstsq(system, (local**2).sum(axis=1), rcond=None)[0]
        return mean + np.array([solution[0], solution[1], 0.0])

"""What a benchmark asks of a method, and what it gets back."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from tomo_polysplat.fit.optimise import FitState
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, from_astra, projections_from_astra
from tomo_polysplat.scan.scan import Scan

__all__ = ["Options", "Outcome", "Task"]


@dataclass(frozen=True)
class Task:
    """A scan as methods take it.

    Attributes
    ----------
    scan : Scan
    projections : (views, rows, columns) float32
        NaN where not measured.
    geometry, grid : Geometry, VolumeGrid
    device : str
    seed : int
    """

    scan: Scan
    projections: np.ndarray
    geometry: Geometry
    grid: VolumeGrid
    device: str
    seed: int = 0

    @classmethod
    def of(cls, scan: Scan, device: str, seed: int = 0) -> Task:
        """The task that a scan sets."""
        geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
        values = scan.projections if scan.valid is None else np.where(scan.valid, scan.projections, np.nan)
        return cls(scan, projections_from_astra(values, scan.proj_geom), geometry, grid, device, seed)

    @property
    def spectrum(self) -> Spectrum:
        """The scan's; benchmarks have one."""
        assert self.scan.spectrum is not None
        return self.scan.spectrum


@dataclass
class Options:
    """What a run may be told.

    Attributes
    ----------
    time_budget : float or None
        Seconds, for methods that improve with time.
    settings : dict
        Changes of the solver's settings.
    callbacks : list
        Called once a pass over the views.
    """

    time_budget: float | None = None
    settings: dict[str, Any] = field(default_factory=dict)
    callbacks: list[Callable[[FitState], Any]] = field(default_factory=list)


Outcome = tuple[np.ndarray, dict[str, Any]]

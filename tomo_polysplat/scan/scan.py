"""What was measured, with everything that is known about it.

Arrays and geometries of a scan follow ASTRA's three-dimensional conventions: projections are
``(rows, views, columns)``, volumes are ``(z, y, x)`` and y ascends with the index. A scan of one plane is
a scan with one detector row and one slice.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_choice, require_shape
from tomo_polysplat.physics.filter_map import require_filter_map
from tomo_polysplat.physics.water_correction import require_water_correction
from tomo_polysplat.scan.counts import Counts, Marks
from tomo_polysplat.units import LENGTH_UNITS

if TYPE_CHECKING:
    from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["Scan"]


@dataclass(eq=False)
class Scan:
    """A measured or simulated scan.

    Parameters
    ----------
    projections : array, or Counts, shape (rows, views, columns)
        Line integrals -log(I/I0), stored as float32, or made of `Counts` that stay where they are.
        Values of invalid rays are not used, except that infinity
        means that no light was seen, and minus infinity more than the detector can tell (:attr:`usable`).
    proj_geom, vol_geom : dict
        ASTRA geometries of three-dimensional type (``parallel3d``, ``parallel3d_vec``, ``cone``,
        ``cone_vec``), lengths in `unit`.
    unit : str
        Unit of the geometry's lengths: ``"cm"``, ``"mm"``, ``"um"``, ``"m"``, or ``"pixel"`` when unknown.
    spectrum : Spectrum or None
        Effective spectrum (tube, filters and detector); None when unknown or monochromatic.
    truth : array, shape (z, y, x), or None
        True attenuation in 1/`unit` at `truth_energy_kev`, where it is known.
    metal_mask : bool array, shape (z, y, x), or None
        Voxels of metal, used for measuring errors only; the reconstruction never sees it.
    truth_energy_kev : float or None
        Photon energy of `truth`; None stands for the spectrum's effective energy.
    name : str
        A name for reports.
    valid : bool array, shape (rows, views, columns), or None
        False where a ray was not measured properly; None when every ray is good.
    water_correction : tuple of float or None
        Coefficients c_0 = 0, c_1, ... of the polynomial in -log(I/I0) that the scanner has applied to
        ``projections``; None if it has applied none.
    filter_map : (material, thickness) or (material, thickness, density), or None
        Filter that is not everywhere as thick, such as a bowtie, with its thickness (rows, columns) in `unit`; see
        :func:`tomo_polysplat.reconstruct`.
    notes : dict
        Counts and choices made while reading, such as the number of rays without light.
    """

    projections: np.ndarray | Counts
    proj_geom: dict[str, Any]
    vol_geom: dict[str, Any]
    unit: str = "cm"
    spectrum: Spectrum | None = None
    truth: np.ndarray | None = None
    metal_mask: np.ndarray | None = None
    truth_energy_kev: float | None = None
    name: str = "scan"
    valid: np.ndarray | Marks | None = None
    water_correction: tuple[float, ...] | None = None
    filter_map: tuple[Any, ...] | None = None
    notes: dict[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not isinstance(self.projections, Counts):
            projections = require_array("projections", self.projections, 3)
            self.projections = np.ascontiguousarray(projections, np.float32)
        if "type" not in self.proj_geom or "GridRowCount" not in self.vol_geom:
            raise fail("proj_geom, vol_geom", "ASTRA geometries", "dicts without 'type' or 'GridRowCount'")
        require_choice("unit", self.unit, LENGTH_UNITS)
        self._check_shape()
        if self.valid is not None:
            if not isinstance(self.valid, Marks):
                self.valid = np.ascontiguousarray(self.valid, bool)
            require_shape("valid", self.valid, self.projections.shape, "(rows, views, columns)")
        if self.filter_map is not None:
            self.filter_map = require_filter_map(self.filter_map)
        if self.water_correction is not None:
            self.water_correction = require_water_correction(self.water_correction)
        if self.truth is not None:
            self.truth = np.ascontiguousarray(require_array("truth", self.truth, 3), np.float32)
            require_shape("truth", self.truth, self.volume_shape, "(z, y, x)")
        if self.metal_mask is not None:
            self.metal_mask = np.ascontiguousarray(require_array("metal_mask", self.metal_mask, 3), bool)
            require_shape("metal_mask", self.metal_mask, self.volume_shape, "(z, y, x)")

    def _check_shape(self) -> None:
        """Refuse projections whose shape is not that of the geometry, if the geometry states one."""
        geometry = self.proj_geom
        views = geometry.get("ProjectionAngles", geometry.get("Vectors"))
        if views is None or not {"DetectorRowCount", "DetectorColCount"} <= geometry.keys():
            return
        told = (int(geometry["DetectorRowCount"]), len(views), int(geometry["DetectorColCount"]))
        require_shape("projections", self.projections, told, "(rows, views, columns)", "as proj_geom says")

    @property
    def usable(self) -> np.ndarray | Marks | None:
        """Rays to pass as ``valid`` to `tomo_polysplat.reconstruct`: also those without light, and saturated ones.

        `reconstruct` tells rays without light from dead pixels, and saturated rays beside the object from others. Add
        your own mask with ``scan.usable & mask``.
        """
        if isinstance(self.valid, Marks):
            return Marks(self.valid.counts, lightless=True)
        return None if self.valid is None else self.valid | np.isinf(self.projections)

    @property
    def rows(self) -> int:
        """Detector rows."""
        return self.projections.shape[0]

    @property
    def views(self) -> int:
        """Projection images."""
        return self.projections.shape[1]

    @property
    def columns(self) -> int:
        """Detector columns."""
        return self.projections.shape[2]

    @property
    def volume_shape(self) -> tuple[int, int, int]:
        """Voxels ``(z, y, x)`` of the volume geometry."""
        grid = self.vol_geom
        return int(grid.get("GridSliceCount", 1)), int(grid["GridRowCount"]), int(grid["GridColCount"])

    def __repr__(self) -> str:
        spectrum = (
            "no spectrum" if self.spectrum is None else f"{self.spectrum.effective_energy:.1f} keV effective"
        )
        return (
            f"Scan({self.name!r}, {self.proj_geom['type']}, rows={self.rows}, views={self.views}, "
            f"columns={self.columns}, volume={self.volume_shape}, unit={self.unit!r}, {spectrum})"
        )

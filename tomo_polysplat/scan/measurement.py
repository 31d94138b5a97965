"""What `reconstruct` is told of a measurement: as named, else as a scan brings it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from tomo_polysplat.checks import fail
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.scan import Scan

__all__ = ["Measurement"]


@dataclass(frozen=True)
class Measurement:
    """The arguments of `reconstruct` that tell of a measurement.

    Attributes
    ----------
    projections : Scan, or array
    proj_geom, vol_geom : dict or None
        ASTRA's; None where a scan brings them.
    unit : str or None
        Of lengths.
    spectrum : Spectrum or None
    valid : bool array or None
        Rays that may be used.
    water_correction : sequence of float or None
        Coefficients of the polynomial that the scanner has put the projections through.
    filter_map : tuple or None
        Material and thickness of a filter in front of each pixel.
    """

    projections: Any
    proj_geom: Mapping[str, Any] | None
    vol_geom: Mapping[str, Any] | None
    unit: str | None
    spectrum: Spectrum | None
    valid: Any
    water_correction: Sequence[float] | None
    filter_map: Sequence[Any] | None = None

    def filled(self) -> Measurement:
        """With what a `Scan` brings, where nothing else is named beside it.

        A scan's water correction was made for a spectrum, and goes with one only.
        """
        if not isinstance(scan := self.projections, Scan):
            return self
        spectrum = scan.spectrum if self.spectrum is None else self.spectrum
        correction = self.water_correction
        if correction is None and spectrum is not None:
            correction = scan.water_correction
        return Measurement(
            scan.projections,
            self.proj_geom or scan.proj_geom,
            self.vol_geom or scan.vol_geom,
            self.unit or scan.unit,
            spectrum,
            scan.usable if self.valid is None else self.valid,
            correction,
            scan.filter_map if self.filter_map is None else self.filter_map,
        )

    def geometries(self) -> tuple[Mapping[str, Any], Mapping[str, Any]]:
        """Both of ASTRA's.

        Raises
        ------
        ValueError
            If one is missing.
        """
        for name, given in (("proj_geom", self.proj_geom), ("vol_geom", self.vol_geom)):
            if given is None:
                raise fail(name, "ASTRA's geometry beside an array of projections", "none", "or pass a Scan")
        assert self.proj_geom is not None and self.vol_geom is not None
        return self.proj_geom, self.vol_geom

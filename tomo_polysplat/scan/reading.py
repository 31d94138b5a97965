"""What the caller of ``load_scan`` says about a file, and how it meets what the file says."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from tomo_polysplat.checks import fail, require_choice
from tomo_polysplat.units import LENGTH_UNITS, warn_of_unit

if TYPE_CHECKING:
    from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["INPUT_KINDS", "ReadOptions"]

INPUT_KINDS = ("counts", "transmission", "attenuation")


@dataclass(frozen=True)
class ReadOptions:
    """The keyword arguments of :func:`tomo_polysplat.load_scan`, checked; None means: as the file says."""

    spectrum: Spectrum | None = None
    unit: str | None = None
    centre: float | None = None
    pixel_size: float | None = None
    theta: Any = None
    input: str | None = None
    saturation: float | None = None
    proj_geom: Mapping[str, Any] | None = None
    vol_geom: Mapping[str, Any] | None = None
    water_correction: Sequence[float] | None = None
    progress: bool | Callable[[float, str], Any] | None = None

    def __post_init__(self) -> None:
        if self.unit is not None:
            require_choice("unit", self.unit, LENGTH_UNITS)
        if self.input is not None:
            require_choice("input", self.input, INPUT_KINDS)
        if self.proj_geom is not None and self.vol_geom is None:
            raise fail("vol_geom", "a volume geometry beside proj_geom", "None")

    def settled_unit(self, stated: str | None, otherwise: str) -> str:
        """Unit of the lengths: the file's, else the caller's, else `otherwise`."""
        if stated is not None:
            require_choice("unit stated in the file", stated, LENGTH_UNITS)
            if self.unit not in (None, stated):
                raise fail("unit", f"'{stated}', which the file states", repr(self.unit), "leave unit out")
            return stated
        if self.unit is None:
            warn_of_unit(otherwise)
        return self.unit or otherwise

    def refuse_parallel_only(self) -> None:
        """Refuse arguments that make sense only for a parallel beam without a geometry in its file."""
        for name in ("centre", "pixel_size", "theta"):
            if getattr(self, name) is not None:
                raise fail(name, "None", "a value", "the geometry is known already and places every pixel")

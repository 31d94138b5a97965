"""A volume for other programs: its numbers, where the voxels are, and what the numbers mean."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.units import CM_PER_UNIT, cm_per

if TYPE_CHECKING:
    from tomo_polysplat.result.data import ResultData

__all__ = ["Image", "image_bytes", "image_of", "require_bits"]

_LEVELS = 65535


@dataclass(frozen=True)
class Image:
    """What goes into a file.

    Attributes
    ----------
    values : float32 or uint16 array, shape (z, y, x)
        Every index ascends with its coordinate.
    voxel_size, first : (x, y, z)
        Size of a voxel and centre of the first one, in `unit`.
    unit : str
        Unit of length.
    quantity : str
        Unit of the numbers: 1/`unit`, or HU.
    energy_kev : float or None
        Photon energy of the numbers.
    slope, offset : float
        The quantity is ``slope * values + offset``.
    window : (low, high)
        Quantities that a viewer shows black and white.
    top_row : str
        Row at the top of a picture: ``"smallest y"``, or ``"largest y"`` after a 2D scan.
    """

    values: np.ndarray
    voxel_size: tuple[float, float, float]
    first: tuple[float, float, float]
    unit: str
    quantity: str
    energy_kev: float | None
    slope: float
    offset: float
    window: tuple[float, float]
    top_row: str

    @property
    def stored_window(self) -> tuple[float, float]:
        """The window in stored numbers, cut to those that exist."""
        low, high = ((value - self.offset) / self.slope for value in self.window)
        return (low, high) if self.values.dtype.kind == "f" else (max(low, 0.0), min(high, float(_LEVELS)))

    def pictures(self) -> Iterator[np.ndarray]:
        """Slice by slice, (rows, columns) with the top row first."""
        for plane in self.values:
            yield plane[::-1] if self.top_row == "largest y" else plane

    def in_millimetres(self) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """`voxel_size` and `first` in mm, which medical programs expect; unchanged for the unit ``"pixel"``."""
        mm = 10 * CM_PER_UNIT.get(self.unit, 0.1)
        return tuple(mm * size for size in self.voxel_size), tuple(mm * at for at in self.first)

    def about(self) -> dict[str, Any]:
        """What a file says beside the numbers, in types that JSON knows."""
        return {
            "program": "tomo-polysplat",
            "unit": self.quantity,
            "energy_kev": self.energy_kev,
            "slope": self.slope,
            "offset": self.offset,
            "voxel_size": list(self.voxel_size),
            "first_voxel": list(self.first),
            "length_unit": self.unit,
            "first_row": self.top_row,
        }

    def about_text(self) -> str:
        """`about` as one line of ASCII."""
        return json.dumps(self.about())


def image_of(result: ResultData, *, hu: bool = False, bits: int = 32, unseen_nan: bool = False) -> Image:
    """The volume of a result.

    Parameters
    ----------
    result : Result
    hu : bool
        Hounsfield units ``1000 (mu / mu_water - 1)`` at the energy of the volume instead of attenuation, with water
        of 1 g/cm3; vacuum is -1000 (doi:10.1259/0007-1285-46-552-1016).
    bits : {32, 16}
        32 for floating point; 16 for whole numbers from 0 to 65535 that span the volume's range. The error of
        ``slope * number + offset`` is then at most half a `slope`.
    unseen_nan : bool
        NaN for the voxels that no ray sees; for floating point.

    Raises
    ------
    ValueError
        For other bits; for Hounsfield units of a volume whose energy or unit of length is unknown.
    """
    from tomo_polysplat.report.slices import display_window

    require_bits(bits)
    if unseen_nan and bits == 16:
        raise fail("unseen_nan", "32 bits, as whole numbers have no NaN", "16")
    volume = result.volume_zyx
    scale, shift, quantity = 1.0, 0.0, f"1/{result.unit}"
    window = display_window(volume)
    if hu:
        scale, shift, quantity = 1000.0 / _water(result), -1000.0, "HU"
    slope, offset, stored = 1.0, 0.0, volume
    if hu and bits == 32:
        stored = volume * np.float32(scale) + np.float32(shift)
    elif bits == 16:
        stored, slope, offset = _whole_numbers(volume)
        slope, offset = slope * scale, offset * scale + shift
    if unseen_nan:
        unseen = result.coverage[None, ::-1] if result.flipped_2d else result.coverage
        stored = np.where(unseen == 0, np.float32(np.nan), stored)
    size = result.grid.voxel_size
    return Image(
        values=stored,
        voxel_size=_rounded(size),
        first=_rounded(result.grid.lower + size / 2),
        unit=result.unit,
        quantity=quantity,
        energy_kev=result.energy_kev,
        slope=slope,
        offset=offset,
        window=(window[0] * scale + shift, window[1] * scale + shift),
        top_row="largest y" if result.flipped_2d else "smallest y",
    )


def _rounded(lengths: np.ndarray) -> tuple[float, float, float]:
    """Lengths without the last digits, which are rounding errors."""
    x, y, z = (float(f"{length:.12g}") for length in lengths)
    return x, y, z


def image_bytes(voxels: int, bits: int = 32) -> int:
    """Bytes of this many voxels, without compression."""
    return voxels * bits // 8


def require_bits(bits: int, argument: str = "bits") -> None:
    """Refuse bits that no format here has."""
    if bits not in (16, 32):
        raise fail(argument, "16 or 32", repr(bits))


def _water(result: ResultData) -> float:
    """Attenuation of water at the energy of the volume, in 1/unit."""
    from tomo_polysplat.physics.materials import mass_attenuation

    if result.energy_kev is None:
        remedy = (
            "they compare with water at one energy: reconstruct with a spectrum, or set result.energy_kev"
        )
        raise fail("hu", "a volume of known energy for Hounsfield units", "none", remedy)
    if result.unit not in CM_PER_UNIT:
        remedy = "pass the unit and size of a pixel to reconstruct"
        raise fail("hu", "real lengths for Hounsfield units", f"the unit {result.unit!r}", remedy)
    return float(mass_attenuation("water", result.energy_kev)) * cm_per(result.unit)


def _whole_numbers(volume: np.ndarray) -> tuple[np.ndarray, float, float]:
    """The volume in 65536 levels with their slope and offset; slice by slice, to save memory."""
    low, high = float(volume.min()), float(volume.max())
    slope = (high - low) / _LEVELS or 1.0
    stored = np.empty(volume.shape, np.uint16)
    for plane, numbers in zip(volume, stored):
        numbers[...] = np.clip(np.rint((plane.astype(np.float64) - low) / slope), 0, _LEVELS)
    return stored, slope, low

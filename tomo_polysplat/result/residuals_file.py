"""How well a result explains its rays, kept beside it: small arrays of an HDF5 file, read back without trust."""

from __future__ import annotations

from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_shape
from tomo_polysplat.result.residuals import Residuals
from tomo_polysplat.scan.hdf5 import find_group, number_attribute, read_numbers

__all__ = ["read_residuals", "write_residuals"]

_GROUP = "residuals"
_BY_VIEW, _BY_PIXEL = ("by_view", "held_out"), ("by_pixel", "bias")
_ARRAYS = ("views", *_BY_VIEW, *_BY_PIXEL, "worst")
_NUMBERS = (
    "rms",
    "within",
    "rms_held_out",
    "rays",
    "photons",
    "worst_value",
    "usual_value",
    "block",
    "deviation",
)
# Far more than are ever kept.
_MOST, _LARGEST = 1 << 20, 1e30


def write_residuals(group: Any, residuals: Residuals | None) -> None:
    """Add them to a group of a file, where there are any."""
    if residuals is None:
        return
    kept = group.create_group(_GROUP)
    for name in _ARRAYS:
        values = np.asarray(getattr(residuals, name))
        kept[name] = values.astype(np.int64 if name == "views" else np.float32)
    numbers = {name: float(getattr(residuals, name)) for name in _NUMBERS}
    # What is missing is not known, of photons without end, and of a deviation none.
    kept.attrs.update({name: number for name, number in numbers.items() if np.isfinite(number)})


def read_residuals(group: Any) -> Residuals | None:
    """Those of a group of a file, None where there are none.

    Raises
    ------
    ValueError
        If they are not what `write_residuals` writes.
    """
    kept = find_group(group, _GROUP)
    if kept is None:
        return None
    arrays = {name: read_numbers(kept, name, most=_MOST).astype(np.float64) for name in _ARRAYS}
    numbers = {name: _number(kept, name) for name in _NUMBERS}
    for name, values in arrays.items():
        if np.isinf(values).any() or np.abs(np.nan_to_num(values)).max(initial=0.0) > _LARGEST:
            raise _wrong(name, "numbers out of range")
    for names, axes in ((_BY_VIEW, arrays["views"]), (_BY_PIXEL, arrays["by_pixel"])):
        for name in names:
            require_shape(f"/polysplat/{_GROUP}/{name}", arrays[name], axes.shape, "as those beside it")
    if arrays["views"].ndim != 1 or arrays["by_pixel"].ndim != 2 or arrays["worst"].shape != (3,):
        raise _wrong("views", "arrays of other axes")
    if not (
        numbers["rays"] >= 0 and numbers["block"] >= 1 and numbers["photons"] > 0 <= numbers["deviation"]
    ):
        raise _wrong("rays", "numbers out of range")
    views = np.nan_to_num(arrays.pop("views")).astype(np.int64)
    whole = {name: int(numbers.pop(name)) for name in ("rays", "block")}
    return Residuals(views=views, **arrays, **numbers, **whole)  # type: ignore[arg-type]


def _number(kept: Any, name: str) -> float:
    value = number_attribute(kept, name)
    if value is None:
        return {"photons": np.inf, "deviation": 0.0}.get(name, np.nan)
    if not abs(value) <= _LARGEST:
        raise _wrong(name, f"{value:g}")
    return value


def _wrong(name: str, got: str) -> Exception:
    return fail(f"/polysplat/{_GROUP}/{name}", "what Result.save writes", got, "the file is damaged")

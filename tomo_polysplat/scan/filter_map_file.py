"""The filter of each pixel in a Data Exchange file."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.hdf5 import find_array, find_group, number_attribute, read_numbers, text_attribute

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.scan.scan import Scan

__all__ = ["read_filter_map", "write_filter_map"]

_NAME = "filter_thickness"


def read_filter_map(file: h5py.File, shape: tuple[int, ...]) -> tuple[Any, ...] | None:
    """`Scan.filter_map` of a scan whose projections have such a ``shape`` (rows, views, columns); None without one."""
    group = find_group(file, "polysplat")
    stored = None if group is None else find_array(group, _NAME)
    if group is None or stored is None:
        return None
    material, density = text_attribute(stored, "material"), number_attribute(stored, "density")
    if material is None:
        raise fail("path", f"the attribute 'material' of /polysplat/{_NAME}", "none")
    thickness = read_numbers(group, _NAME, most=shape[0] * shape[2])
    return (material, thickness) if density is None else (material, thickness, density)


def write_filter_map(group: h5py.Group, scan: Scan) -> None:
    """Into the group ``/polysplat``."""
    if scan.filter_map is None:
        return
    material, thickness, density = scan.filter_map
    group[_NAME] = thickness
    group[_NAME].attrs.update(material=material, density=density, unit=scan.unit)

"""Arrays of Data Exchange files through dxchange where it is installed, through h5py otherwise.

Only whole arrays and blocks of views go through dxchange, and only when they are read: on a full disk its
writer ends the process. Its readers of complete scans make up the angles 0 to
180 degrees, end point included, when a file has none, and leave out what they do not find; these choices are
made in the open by `data_exchange`.
"""

from __future__ import annotations

import logging
from importlib import import_module
from importlib.util import find_spec
from types import ModuleType
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from tomo_polysplat.scan.hdf5_array import StoredArray

__all__ = ["real_dxchange", "read_block"]

logger = logging.getLogger(__name__)

# What the tomography package has; another package of the same name is on PyPI.
OFFERS = ("read_aps_tomoscan_hdf5", "read_hdf5", "write_hdf5")


def real_dxchange() -> ModuleType | None:
    """The tomography package dxchange, or None where it is missing, broken, or the unrelated one of its name."""
    try:
        if find_spec("dxchange") is None:
            return None
        module = import_module("dxchange")
    except Exception as error:  # a stranger's module may fail in any way when imported
        logger.info("dxchange cannot be imported (%s): h5py reads and writes instead", error)
        return None
    return module if all(hasattr(module, name) for name in OFFERS) else None


def read_block(dataset: StoredArray, part: slice = slice(None)) -> np.ndarray:
    """A dataset of an open file, or the block `part` along its first axis.

    What has filters or is virtual does not go through dxchange, which leaves all of it to HDF5.
    """
    host = real_dxchange()
    if host is None or dataset.ndim == 0 or not dataset.plain:
        return dataset[part] if dataset.ndim else dataset[()]
    array = host.read_hdf5(dataset.file.filename, dataset.name, slc=(part.indices(len(dataset)),))
    if array is None:
        raise OSError(f"dxchange did not read {dataset.name} of {dataset.file.filename}")
    return array

"""A Data Exchange file to change, and a plain stack of TIFFs."""

import h5py
import numpy as np
import pytest
from discs import COLUMNS, ROWS, discs
from folders import marked

from tomo_polysplat.simulate.folders.write import write_folder


@pytest.fixture
def exchange(tmp_path):
    """Write a Data Exchange file of the discs; keyword arguments replace or (None) remove datasets."""

    def write(**changes):
        theta = np.linspace(0, 180, 91)
        lines = discs(np.deg2rad(theta)).transpose(1, 0, 2)
        content = {
            "data": (100 + 40000 * np.exp(-lines)).astype(np.float32),
            "data_white": np.full((3, ROWS, COLUMNS), 40100, np.float32),
            "data_dark": np.full((2, ROWS, COLUMNS), 100, np.float32),
            "theta": theta,
        }
        path = tmp_path / "scan.h5"
        with h5py.File(path, "w") as file:
            for name, value in (content | changes).items():
                if value is not None:
                    file[f"exchange/{name}"] = value
        return path, lines

    return write


@pytest.fixture(scope="module")
def tiff_stack(tmp_path_factory):
    """A folder of TIFFs with its scan.toml."""
    place = tmp_path_factory.mktemp("stack") / "sample"
    write_folder("tiffs", place, marked())
    return place


@pytest.fixture
def bare(tiff_stack, tmp_path):
    """The pictures alone."""
    for file in tiff_stack.glob("*.tif"):
        (tmp_path / file.name).symlink_to(file)
    return tmp_path

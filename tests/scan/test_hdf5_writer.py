"""What is all zeros is not handed to the disk, and is in the file all the same."""

import os

import h5py
import numpy as np
import pytest

from tomo_polysplat.scan import hdf5_writer
from tomo_polysplat.scan.hdf5_writer import new_hdf5

BLOCK = 64


@pytest.fixture
def written(monkeypatch):
    """Bytes that are written; blocks are small."""
    monkeypatch.setattr(hdf5_writer, "_BLOCK", BLOCK)
    monkeypatch.setattr(hdf5_writer, "_PIECE", 3 * BLOCK)
    sizes, write = [], os.pwrite
    monkeypatch.setattr(hdf5_writer.os, "pwrite", lambda *parts: sizes.append(len(parts[1])) or write(*parts))
    return sizes


@pytest.mark.parametrize("seed", range(8))
def test_bytes_that_are_not_zeros_are_found_by_whole_blocks(written, seed):
    rng = np.random.default_rng(seed)
    data = np.zeros(int(rng.integers(0, 20 * BLOCK)), np.uint8)
    data[rng.integers(0, len(data), 3 if len(data) else 0)] = 1
    runs = hdf5_writer._lit(memoryview(data))
    lit = np.zeros(len(data), bool)
    for first, last in runs:
        assert first % BLOCK == 0 and first < last and not lit[first:last].any()
        lit[first:last] = True
    assert not data[~lit].any()
    whole = len(data) // BLOCK * BLOCK
    assert (lit[:whole].reshape(-1, BLOCK).any(axis=1) == data[:whole].reshape(-1, BLOCK).any(axis=1)).all()


@pytest.mark.parametrize("room", [True, False])
def test_a_file_holds_the_zeros_that_were_not_written(tmp_path, monkeypatch, written, room):
    """Also those that take the place of other values, and where a file system takes no room ahead."""
    if not room:
        monkeypatch.setattr(hdf5_writer, "_take_room", lambda *_: None)
    values = np.zeros((40, 50, 7), np.float32)
    values[3, 4], values[30:33] = 1.5, np.random.default_rng(0).normal(size=(3, 50, 7))
    with new_hdf5(tmp_path / "v.h5", overwrite=False, needed_bytes=2 * values.nbytes) as file:
        slabs = file.create_dataset("slabs", values.shape, np.float32)
        slabs[:20] = 9.0
        for first in range(0, 40, 10):
            slabs[first : first + 10] = values[first : first + 10]
        before = sum(written)
        file["whole"] = values
        file["none"] = np.zeros(1000)
        file.attrs["words"] = "to the end"
    assert sum(written) - before < 0.5 * values.nbytes
    with h5py.File(tmp_path / "v.h5") as file:
        for name in ("slabs", "whole"):
            np.testing.assert_array_equal(file[name][:], values)
        assert not file["none"][:].any() and file.attrs["words"] == "to the end"


def test_zeros_behind_an_end_that_moved_back_are_written(tmp_path, written):
    """HDF5 may cut a file and let it grow again: what was there is not what is to be there."""
    with open(tmp_path / "v", "w+b", buffering=0) as file:
        patient = hdf5_writer._PatientFile(file.fileno())
        patient.write(b"\1" * 3 * BLOCK)
        patient.truncate(BLOCK)
        patient.seek(BLOCK)
        patient.write(bytes(2 * BLOCK))
        patient.finish()
    assert (tmp_path / "v").read_bytes() == b"\1" * BLOCK + bytes(2 * BLOCK)

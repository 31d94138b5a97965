"""An array in an HDF5 file that is read in parts, within bounds that are known before.

What is read how: plain data by HDF5; chunks behind deflate, shuffle and fletcher32 by `hdf5_chunks`; behind any
other filter by HDF5 in a process of its own (`hdf5_child`), with hdf5plugin where that is installed; virtual
datasets by `hdf5_virtual`.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.files import require_plausible_size
from tomo_polysplat.scan.hdf5_chunks import UNPACKED_HERE, Box, chunk_table, filters_of, read_chunks

if TYPE_CHECKING:
    import h5py

__all__ = ["StoredArray"]

_ADDRESS_BYTES = 8
# Of a chunk that is larger than the whole dataset, as in one that was made to grow.
_LARGEST_CHUNK = 2**28
# Zeros under blosc, zstd or bitshuffle become so many times smaller than under deflate.
_OTHER_FILTERS = 100


class StoredArray:
    """A dataset, checked before anything of it is read.

    Parameters
    ----------
    dataset : h5py.Dataset
        Of numbers or of texts of fixed length.
    where : str
        What errors call it.
    depth : int
        Virtual datasets on the way to this one.

    Raises
    ------
    ValueError
        If it declares more than the file stores, or is stored in a way that is not read.
    MemoryError
        If it is too large for the free memory.
    """

    def __init__(self, dataset: h5py.Dataset, where: str, depth: int = 0) -> None:
        self.dataset, self.where, self.depth = dataset, where, depth
        self.shape, self.dtype, self.ndim = tuple(dataset.shape), dataset.dtype, dataset.ndim
        self.size, self.nbytes = math.prod(self.shape), math.prod(self.shape) * dataset.dtype.itemsize
        self.name, self.file, self.attrs, self.id = dataset.name, dataset.file, dataset.attrs, dataset.id
        self._file_size = Path(dataset.file.filename).stat().st_size
        self._table: Any = None
        self._sources: Any = None
        self.filters = () if dataset.is_virtual or not dataset.chunks else filters_of(dataset)
        if dataset.external:
            names = ", ".join(sorted({str(name) for name, _, _ in dataset.external}))
            raise fail(where, "data in the file", f"raw data in {names}", "copy them into an HDF5 file")
        if dataset.is_virtual:
            from tomo_polysplat.scan.hdf5_virtual import sources_of

            self._sources = sources_of(self)
            self._require_stored(
                self.nbytes, sum(source.size for source in self._sources) * self.dtype.itemsize
            )
        else:
            self._require_stored(self.nbytes)
        if dataset.chunks:
            self._require_chunks()

    @property
    def plain(self) -> bool:
        """Whether HDF5 reads it without any filter or other file."""
        return self._sources is None and not self.filters

    @property
    def other_files(self) -> set[str]:
        """Names of the files that it is put together from, but for its own."""
        return {source.file for source in self._sources or ()} - {"."}

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> np.ndarray:
        """A part, by whole numbers and slices with steps above 0; ``[()]`` is all of it."""
        box, single = self._box(key)
        found = self._read(box)
        if found.dtype == bool:
            # Of one byte each, of which a damaged file may hold any.
            found = found.view(np.uint8) != 0
        return found.reshape([len(part) for part, one in zip(box, single) if not one])

    def _box(self, key: Any) -> tuple[Box, list[bool]]:
        keys = list(key) if isinstance(key, tuple) else [key]
        if keys == [Ellipsis]:
            keys = []
        keys += [slice(None)] * (self.ndim - len(keys))
        if len(keys) > self.ndim:
            raise IndexError(f"{len(keys)} indices for {self.ndim} axes")
        single = [not isinstance(part, slice) for part in keys]
        parts = [
            range(length)[part]
            if isinstance(part, slice)
            else range(range(length)[part], range(length)[part] + 1)
            for part, length in zip(keys, self.shape)
        ]
        if any(part.step < 1 for part in parts):
            raise IndexError("steps below 1")
        return tuple(parts), single

    def _read(self, box: Box) -> np.ndarray:
        if self._sources is not None:
            from tomo_polysplat.scan.hdf5_virtual import read_sources

            return read_sources(self, self._sources, box)
        if self.dataset.chunks and self._table is None:
            self._table = chunk_table(self.dataset, self.where, self._file_size, self.dtype.itemsize)
        if not self.filters:
            return np.asarray(self.dataset[tuple(slice(part.start, part.stop, part.step) for part in box)])
        if not self._unpacked_here():
            from tomo_polysplat.scan.hdf5_child import read_apart

            return read_apart(self.dataset, box, self.where)
        out = self.filled([len(part) for part in box])
        read_chunks(self.dataset, self.where, self._table, box, out)
        return out

    def filled(self, shape: list[int]) -> np.ndarray:
        """An array of what stands where a file has nothing."""
        fill = self.dataset.fillvalue
        return np.zeros(shape, self.dtype) if fill is None else np.full(shape, fill, self.dtype)

    def _unpacked_here(self) -> bool:
        """Whether the filters are known and the bytes are those of NumPy's type."""
        import h5py

        same = self.dataset.id.get_type().equal(h5py.h5t.py_create(self.dtype, logical=True))
        return {number for number, _ in self.filters} <= UNPACKED_HERE and bool(same)

    def _require_stored(self, declared: int, stored: int | None = None) -> None:
        if stored is None:
            stored = min(self.dataset.id.get_storage_size(), self._file_size)
            if not {number for number, _ in self.filters} <= UNPACKED_HERE:
                stored *= _OTHER_FILTERS
        require_plausible_size(self.where, declared, stored)

    def _require_chunks(self) -> None:
        """Refuse more chunks than the file can have addresses of, and such as only a bomb has."""
        chunk = math.prod(self.dataset.chunks) * self.dtype.itemsize
        self._require_stored(chunk)
        if chunk > max(_LARGEST_CHUNK, self.nbytes):
            raise fail(self.where, f"chunks of at most {_LARGEST_CHUNK} bytes", f"{chunk}", "damaged file")
        chunks = math.prod(-(-length // size) for length, size in zip(self.shape, self.dataset.chunks))
        most = max(self._file_size // _ADDRESS_BYTES, 1)
        if chunks > most:
            raise fail(
                self.where, f"at most {most} chunks in a file of this size", f"{chunks}", "damaged file"
            )

"""One reconstruction out of the chunks that TomoPy makes of it.

``tomopy.recon`` cuts the slices into chunks and calls the algorithm once for each, from several threads or
one after the other. No call may wait for another, as there may be fewer threads than chunks. So each call
only reports its slices and returns; the one that makes the volume complete reconstructs it. ``tomopy.recon``
returns after the last.

What a chunk does not say is how many slices there are and to which of several simultaneous reconstructions
it belongs. Both follow from the arrays of which ``tomo[a:b]``, ``center[a:b]`` and ``recon[a:b]`` are views:
TomoPy makes at least one of the three itself, with exactly as many slices as there are. Only a caller whose
own float32 arrays are used for all three, and are all three parts of larger ones, could mislead us.
"""

from __future__ import annotations

import logging
import threading
import weakref
from collections.abc import Sequence

import numpy as np

from tomo_polysplat.checks import fail, require_shape

__all__ = ["ChunkCollector"]

logger = logging.getLogger(__name__)

Key = tuple[int, ...]


class _Call:
    """Slices that have come: where their images and sinograms lie in memory, and their centres."""

    def __init__(self, slices: int) -> None:
        self.slices = slices
        self.pieces: dict[int, tuple[int, np.ndarray]] = {}
        self.finalizers: list[weakref.finalize] = []

    @property
    def arrived(self) -> int:
        return sum(len(centres) for _, centres in self.pieces.values())


class ChunkCollector:
    """Collects the chunks of any number of simultaneous calls. Holds no reference to their arrays."""

    def __init__(self) -> None:
        self._calls: dict[Key, _Call] = {}
        # A finaliser may run in the middle of `add`, in the same thread.
        self._lock = threading.RLock()

    def add(
        self, tomo: np.ndarray, center: np.ndarray, recon: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Take in one chunk.

        Parameters
        ----------
        tomo : array, shape (slices, views, columns)
        center : array, shape (slices,)
        recon : array, shape (slices, y, x)
            Each lacks its first axis with ``nchunk=0``.

        Returns
        -------
        tuple or None
            The whole of the three arrays when this chunk was the last; None when others are to come.

        Raises
        ------
        ValueError
            If shapes disagree, a slice comes twice, or the number of slices cannot be known.
        """
        roots = [_root(tomo), _root(recon)]
        # A number, or one number repeated, has no memory that would tell the number of slices.
        if isinstance(center, np.ndarray) and 0 not in center.strides:
            roots.append(_root(center))
        centres = np.array(center, np.float32, ndmin=1)
        if recon.ndim == 2:
            tomo, recon = tomo[None], recon[None]
        if tomo.ndim != 3 or recon.ndim != 3:
            raise fail("tomo, recon", "stacks of slices", f"shapes {tomo.shape} and {recon.shape}")
        require_shape("recon", recon, (len(tomo), *recon.shape[1:]), "(slices, y, x)", "check init_recon")
        require_shape("center", centres, (len(tomo),), "(slices,)")
        sizes = (tomo[0].nbytes, recon[0].nbytes, centres.itemsize)
        counts = [root.nbytes // size for root, size in zip(roots, sizes)]
        slices = min(counts)
        if len(roots) == 2 and counts[0] != counts[1]:
            raise fail("nchunk", "a number > 0 for parts of larger arrays", "0", "nchunk=1 does the same")
        if slices == len(tomo):
            return tomo, centres, recon
        with self._lock:
            call = self._call_of(roots, slices)
            if _address(recon) in call.pieces:
                raise fail("recon", "every slice once", "a slice twice", "let one call end first")
            call.pieces[_address(recon)] = _address(tomo), centres
            if call.arrived < slices:
                return None
            del self._calls[_key(roots)]
            for finalizer in call.finalizers:
                finalizer.detach()
        images, pieces = zip(*sorted(call.pieces.items()))
        sinograms, parts = zip(*pieces)
        lengths = [len(part) for part in parts]
        volume = _whole(recon, roots[1], images, lengths)
        return _whole(tomo, roots[0], sinograms, lengths), np.concatenate(parts), volume

    def _call_of(self, roots: list[np.ndarray], slices: int) -> _Call:
        key = _key(roots)
        if key not in self._calls:
            call = self._calls[key] = _Call(slices)
            # The identity of an array may be given to another once it is gone.
            call.finalizers = [weakref.finalize(root, self._forget, key) for root in roots]
        return self._calls[key]

    def _forget(self, key: Key) -> None:
        with self._lock:
            call = self._calls.pop(key, None)
        if call is not None:
            logger.warning("%d of %d slices came: nothing was reconstructed", call.arrived, call.slices)


def _root(array: np.ndarray) -> np.ndarray:
    """The array that owns the memory."""
    while isinstance(array.base, np.ndarray):
        array = array.base
    return array


def _key(roots: list[np.ndarray]) -> Key:
    return tuple(id(root) for root in roots)


def _address(array: np.ndarray) -> int:
    return array.__array_interface__["data"][0]


def _whole(chunk: np.ndarray, root: np.ndarray, addresses: Sequence[int], lengths: list[int]) -> np.ndarray:
    """All slices as one view of the memory of `root`, given where the pieces start and how long they are."""
    size = chunk[0].nbytes
    expected = addresses[0] + size * np.cumsum([0, *lengths])
    memory = root.ravel(order="K").view(np.uint8)
    if not np.array_equal(addresses, expected[:-1]) or not np.may_share_memory(memory, root):
        raise fail("tomo, recon", "slices one after the other in memory", "others", "pass ncore=1")
    start = addresses[0] - _address(memory)
    whole = memory[start : start + size * sum(lengths)].view(chunk.dtype)
    return whole.reshape(sum(lengths), *chunk.shape[1:])

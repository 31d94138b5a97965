"""Counts of a detector that stay where they are: their line integrals are made when they are looked at."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager, closing, nullcontext
from dataclasses import dataclass
from math import prod
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_number
from tomo_polysplat.parallel import run_tasks, split_range
from tomo_polysplat.scan.defects import attenuation, flat_and_dark, unusable

__all__ = ["Block", "Counts", "Marks"]

# Rays of a block that is read at once, and of a part of it, whose logarithm is taken in float64 by one thread.
_BLOCK, _PART = 1 << 24, 1 << 18

Read = Callable[[slice], np.ndarray]


@dataclass(frozen=True)
class Block:
    """Views that were read together.

    Attributes
    ----------
    views : slice
    values : (views, rows, columns) float32 array
        -log(I/I0), as `tomo_polysplat.scan.defects.attenuation` has it.
    usable : bool array of that shape
        Whether a ray was measured properly.
    found : dict
        How many rays of each kind were not.
    """

    views: slice
    values: np.ndarray
    usable: np.ndarray
    found: dict[str, int]

    @property
    def marked(self) -> np.ndarray:
        """Rays that are not to be used; of those without light, or saturated, `reconstruct` judges itself."""
        return ~(self.usable | np.isinf(self.values))


class _MadeWhenLookedAt(np.lib.mixins.NDArrayOperatorsMixin, ABC):
    """An array (rows, views, columns) of which only what is looked at is ever made."""

    ndim = 3

    def __init__(self, shape: tuple[int, int, int], dtype: Any) -> None:
        self.shape, self.dtype = shape, np.dtype(dtype)

    @property
    def size(self) -> int:
        """How many rays there are."""
        return prod(self.shape)

    @property
    def nbytes(self) -> int:
        """Bytes that all of it would take."""
        return self.size * self.dtype.itemsize

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError("what is made when it is looked at is always a copy")
        return self[:, :, :].astype(self.dtype if dtype is None else dtype, copy=False)

    def __getattr__(self, name: str) -> Any:
        # What else an array has, of all of it.
        if name.startswith("_") or not hasattr(np.ndarray, name):
            raise AttributeError(f"{type(self).__name__} has no {name}")
        return getattr(np.asarray(self), name)

    def __array_ufunc__(self, ufunc: np.ufunc, method: str, *inputs: Any, **options: Any) -> Any:
        arrays = [np.asarray(one) if isinstance(one, _MadeWhenLookedAt) else one for one in inputs]
        return getattr(ufunc, method)(*arrays, **options)

    def __getitem__(self, key: Any) -> np.ndarray:
        """As of an array."""
        keys = key if isinstance(key, tuple) else (key,)
        if len(keys) > self.ndim or any(one is None or one is Ellipsis or np.ndim(one) > 2 for one in keys):
            return np.asarray(self)[key]
        keys += (slice(None),) * (self.ndim - len(keys))
        needed = [_needed(one, length) for one, length in zip(keys, self.shape)]
        (rows, of_rows), (views, of_views), (columns, of_columns) = needed
        return self._made(rows, views, columns)[of_rows, of_views, of_columns]

    def __setitem__(self, key: Any, value: Any) -> None:
        remedy = "change numpy.asarray of it, or pass valid="
        raise fail("projections", "no change of what stays where it is", "an assignment", remedy, TypeError)

    def swapaxes(self, first: int, second: int) -> Any:
        """As of an array; with views before rows nothing is made before that is looked at."""
        return _ViewsFirst(self) if {first, second} == {0, 1} else np.asarray(self).swapaxes(first, second)

    @abstractmethod
    def _made(self, rows: np.ndarray, views: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """What is where these rows, views and columns meet, each of them rising."""


class _ViewsFirst:
    """The same (views, rows, columns), for who looks at parts of it by two slices or lists."""

    def __init__(self, stored: _MadeWhenLookedAt) -> None:
        self._stored = stored

    def __getitem__(self, key: tuple[Any, Any]) -> np.ndarray:
        views, rows = key
        return self._stored[rows, views].swapaxes(0, 1)


class Counts(_MadeWhenLookedAt):
    """Line integrals -log(I/I0) of counts that stay in a file, or in an array of few bytes a ray.

    To whoever reads it this is a float32 array (rows, views, columns), as `Scan` and `reconstruct` take one. What is
    looked at is made anew each time, and ``numpy.asarray`` makes all of it.

    Parameters
    ----------
    opened : callable
        Gives a context in which a function of a slice of views reads them as (views, rows, columns).
    shape : (views, rows, columns)
    kind, flat, dark, saturation
        See `tomo_polysplat.scan.defects.attenuation`.

    Attributes
    ----------
    found : dict or None
        How many rays of each kind were not measured properly; None before all were looked through.
    """

    # What the numbers are, a word each.
    def __init__(
        self,
        opened: Callable[[], AbstractContextManager[Read]],
        shape: tuple[int, int, int],
        kind: str = "counts",
        flat: np.ndarray | None = None,
        dark: np.ndarray | None = None,
        saturation: float | None = None,
    ) -> None:
        views, rows, columns = shape
        super().__init__((rows, views, columns), np.float32)
        self._opened = opened
        self._kind, self._flat, self._dark, self._saturation = kind, flat, dark, saturation
        self.found: dict[str, int] | None = None

    @classmethod
    def of(cls, counts: Any, white: Any, dark: Any = None, *, saturation: float | None = None) -> Counts:
        """Those of an array, such as a ``numpy.memmap`` of a camera's file.

        Parameters
        ----------
        counts : array, shape (views, rows, columns)
            What the detector counted, of any type.
        white, dark : array, shape (images, rows, columns) or (rows, columns)
            Images without an object, and without light; no dark image means zero.
        saturation : float or None
            Counts at which the detector saturates; None takes the largest value of an integer type.

        Raises
        ------
        ValueError
            If the shapes do not fit, or the white images have no more light than the dark ones.
        """
        stored = require_array("counts", counts, 3, "(views, rows, columns)")
        if not stored.size:
            raise fail("counts", "some views", f"shape {stored.shape}")
        if saturation is not None:
            saturation = require_number("saturation", saturation)
        views, rows, columns = stored.shape
        flat, background = flat_and_dark(white, dark, (rows, columns))
        shape = (views, rows, columns)
        return cls(lambda: nullcontext(stored.__getitem__), shape, "counts", flat, background, saturation)

    @property
    def marks(self) -> Marks:
        """Which rays were measured properly."""
        return Marks(self, lightless=False)

    @property
    def at_once(self) -> int:
        """Views that are read together."""
        return max(1, _BLOCK // (self.shape[0] * self.shape[2]))

    def blocks(self, into: np.ndarray | None = None) -> Iterator[Block]:
        """All views, some at a time, in their order; the next ones are read meanwhile.

        `into`, a (views, rows, columns) float32 array, gets the line integrals, of which blocks then have views.
        """
        with closing(self._stored()) as stored:
            for part, values in stored:
                made = None if into is None else into[part]
                yield Block(part, *self._judged(values, self._flat, self._dark, made))

    def unusable(self) -> Iterator[tuple[slice, dict[str, int]]]:
        """Some views after others, and how many of their rays of each kind were not measured properly."""
        with closing(self._stored()) as stored:
            for part, values in stored:
                yield part, self._counted(values)

    def _stored(self) -> Generator[tuple[slice, np.ndarray], None, None]:
        """All views as they are stored, some at a time, the next ones read meanwhile."""
        views = self.shape[1]
        chosen = [slice(k, min(k + self.at_once, views)) for k in range(0, views, self.at_once)]
        with self._opened() as read, closing(_ahead(read, chosen)) as ahead:
            yield from zip(chosen, ahead)

    def some(
        self, rows: np.ndarray, views: np.ndarray, columns: np.ndarray
    ) -> Iterator[tuple[slice, np.ndarray, np.ndarray]]:
        """Line integrals and whether they are usable, (views, rows, columns), for each run of neighbouring views.

        Parameters
        ----------
        rows, views, columns : array of int
            Which, rising.
        """
        pixels = np.ix_(rows, columns)
        flat, dark = (None if image is None else image[pixels] for image in (self._flat, self._dark))
        with self._opened() as read:
            for begin, end in _runs(views, self.at_once):
                stored = read(slice(int(views[begin]), int(views[end - 1]) + 1))
                if len(rows) < stored.shape[1] or len(columns) < stored.shape[2]:
                    stored = stored[:, rows[:, None], columns]
                values, usable, _ = self._judged(stored, flat, dark)
                yield slice(begin, end), values, usable

    def _judged(
        self,
        stored: np.ndarray,
        flat: np.ndarray | None,
        dark: np.ndarray | None,
        made: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray, dict[str, int]]:
        """What `attenuation` makes of some views, by several threads, in `made` where that is given."""
        values = np.empty(stored.shape, np.float32) if made is None else made
        usable = np.empty(stored.shape, bool)

        def judge(
            part: tuple[slice, slice], light: np.ndarray | None, background: np.ndarray | None
        ) -> dict[str, int]:
            into = values[part], usable[part]
            return attenuation(stored[part], self._kind, light, background, self._saturation, into)[2]

        return values, usable, _by_parts(judge, stored.shape, flat, dark)

    def _counted(self, stored: np.ndarray) -> dict[str, int]:
        """What `unusable` finds in some views, by several threads."""

        def count(
            part: tuple[slice, slice], light: np.ndarray | None, background: np.ndarray | None
        ) -> dict[str, int]:
            return unusable(stored[part], self._kind, light, background, self._saturation)

        return _by_parts(count, stored.shape, self._flat, self._dark)

    def _made(self, rows: np.ndarray, views: np.ndarray, columns: np.ndarray) -> np.ndarray:
        made = np.empty((len(rows), len(views), len(columns)), np.float32)
        for part, values, _ in self.some(rows, views, columns):
            made[:, part] = values.transpose(1, 0, 2)
        return made

    def __repr__(self) -> str:
        return f"Counts(rows, views, columns = {self.shape})"


class Marks(_MadeWhenLookedAt):
    """Which rays of `Counts` were measured properly, a bool array (rows, views, columns) to whoever reads it.

    Parameters
    ----------
    counts : Counts
    lightless : bool
        Whether rays without light, or saturated, count as such; see `Scan.usable`.
    """

    def __init__(self, counts: Counts, *, lightless: bool) -> None:
        rows, views, columns = counts.shape
        super().__init__((rows, views, columns), bool)
        self.counts, self.lightless = counts, lightless

    def _made(self, rows: np.ndarray, views: np.ndarray, columns: np.ndarray) -> np.ndarray:
        made = np.ones((len(rows), len(views), len(columns)), bool)
        if self.counts.found is not None and not any(self.counts.found.values()):
            return made
        for part, values, usable in self.counts.some(rows, views, columns):
            if self.lightless:
                usable |= np.isinf(values)
            made[:, part] = usable.transpose(1, 0, 2)
        return made

    def __repr__(self) -> str:
        return f"Marks(rows, views, columns = {self.shape})"


def _needed(key: Any, length: int) -> tuple[np.ndarray, Any]:
    """Which of an axis are wanted, rising, and the key that takes them from these."""
    wanted = np.arange(length)[key]
    if wanted.ndim == 0:
        return wanted[None], 0
    if isinstance(key, slice) and key.step in (None, 1):
        return wanted, slice(None)
    if isinstance(key, slice):
        return (wanted, slice(None)) if key.step > 0 else (wanted[::-1], slice(None, None, -1))
    chosen, place = np.unique(wanted, return_inverse=True)
    return chosen, place.reshape(wanted.shape)


def _parts(shape: tuple[int, ...]) -> list[tuple[slice, slice]]:
    """Views and rows of each part that a thread looks at: some rows of one view, or some whole views.

    A view is one call of a compiled loop: threads that call it for a few rows each wait for the interpreter.
    """
    views, rows, columns = shape
    if rows * columns >= _PART:
        ends = split_range(rows, rows * columns // _PART)
        return [(slice(view, view + 1), slice(a, b)) for view in range(views) for a, b in ends]
    return [(slice(a, b), slice(rows)) for a, b in split_range(views, -(-prod(shape) // _PART))]


def _by_parts(
    look: Callable[..., dict[str, int]],
    shape: tuple[int, ...],
    flat: np.ndarray | None,
    dark: np.ndarray | None,
) -> dict[str, int]:
    """Sums of what a function counts in parts of (views, rows, columns), with the light of their pixels."""
    parts = _parts(shape)
    lights = [tuple(image if image is None else image[part[1]] for image in (flat, dark)) for part in parts]
    found = run_tasks(look, [(part, *light) for part, light in zip(parts, lights)])
    return {name: sum(one[name] for one in found) for name in found[0]}


def _ahead(read: Read, chosen: Sequence[slice]) -> Generator[np.ndarray, None, None]:
    """What is read of each, the next one while the last one is used."""
    if len(chosen) == 1:
        yield read(chosen[0])
        return
    with ThreadPoolExecutor(1) as reader:
        following = reader.submit(read, chosen[0])
        for part in [*chosen[1:], None]:
            stored = following.result()
            if part is not None:
                following = reader.submit(read, part)
            yield stored
            del stored


def _runs(views: np.ndarray, most: int) -> Iterator[tuple[int, int]]:
    """Where runs of neighbours of at most so many begin and end."""
    begin = 0
    for end in range(1, len(views) + 1):
        if end == len(views) or views[end] != views[end - 1] + 1 or end - begin == most:
            yield begin, end
            begin = end

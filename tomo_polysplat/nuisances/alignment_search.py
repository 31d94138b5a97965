"""In what order a scanner's moves are found: from coarse to fine, and each kind only where held-out rays say so.

The caller fits Gaussians, which this does not know of: `search` asks for one short fit after the other.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from tomo_polysplat.nuisances.alignment import Alignment

__all__ = ["Schedule", "levels", "schedule", "search", "worth_it"]

logger = logging.getLogger(__name__)

# Columns of the coarsest and of the finest joined detector, and those on which an axis that is off by a quarter of a
# pixel shows: where nothing is confirmed there, nothing is looked for on finer ones.
_COARSEST, _FINEST, _ENOUGH = 15, 64, 30


@dataclass(frozen=True)
class Schedule:
    """Steps of a level, in pixels of its detector, at its start and at its end; in between in equal ratios."""

    first: float
    last: float

    def rate(self, share: float, factor: int) -> float:
        """Of one step when so much of the level is done, in pixels of the detector, of which ``factor`` are joined."""
        return factor * self.first * (self.last / self.first) ** share


def schedule(level: int, factor: int) -> Schedule:
    """The steps of a level: large in the first (0), small where pixels are not joined (``factor`` 1)."""
    if factor == 1:
        return Schedule(0.03, 0.003)
    return Schedule(0.25, 0.025) if level == 0 else Schedule(0.1, 0.005)


def levels(columns: int) -> list[int]:
    """How many columns, and rows, are joined to one, from coarse to fine, in powers of two.

    The coarsest detector has 15 to 29 columns, on which an offset by a sixth of the width is found, the finest 64 at
    least, if there are as many.
    """
    factors = [1]
    while columns // (2 * factors[-1]) >= _COARSEST:
        factors.append(2 * factors[-1])
    finest = max([1, *(f for f in factors if columns // f >= _FINEST)])
    return [f for f in reversed(factors) if f >= finest]


def worth_it(told: float, moved: float) -> bool:
    """Whether the misfit of held-out rays says that the moves are there: as told, and moved, by fits alike."""
    return Alignment.gate({"without": told, "moved": moved}).kept


def search(
    alignment: Alignment, fit_level: Callable[[int, int, tuple[str, ...]], float], factors: Sequence[int]
) -> dict[str, Any]:
    """Find the moves of a scanner; those that no level confirms are put back, and not stepped any more.

    Moves of the whole scanner come before those of single views. A kind that a level has confirmed moves on in all
    finer ones without being asked again: there it has little left to gain. Views are not asked for the first time by
    pixels that are not joined. Where nothing is confirmed by joined pixels of 30 columns, the search ends.

    Parameters
    ----------
    alignment : Alignment
        Changed in place.
    fit_level : callable
        Of (level, factor, names of what moves): fits Gaussians anew, for some six passes, to projections by pixels of
        which ``factor`` are joined along rows and columns, while it steps the moves named and keeps the others where
        they are; gives the mean misfit of the held-out rays over the last two passes. The start is that of projections
        as the told geometry would have seen them (`tomo_polysplat.scan.as_told`). A tenth of the rays should be held
        out, the same ones in every fit.
    factors : sequence of int
        As `levels` gives them.

    Returns
    -------
    dict
        ``confirmed`` names, and of every level in ``levels`` its factor and the misfits: ``without``, and of each kind
        that was asked for.
    """
    kinds = {"whole": tuple(name for name in alignment.names if name != "views"), "views": ("views",)}
    kinds = {kind: names for kind, names in kinds.items() if names and set(names) <= set(alignment.names)}
    confirmed: tuple[str, ...] = ()
    record: list[dict[str, Any]] = []
    for level, factor in enumerate(factors):
        without = fit_level(level, factor, confirmed)
        told, found = {"factor": factor, "without": without}, False
        open_kinds = {kind: names for kind, names in kinds.items() if not set(names) <= set(confirmed)}
        if factor == 1 and level:
            open_kinds.pop("views", None)
        for kind, names in open_kinds.items():
            if found:
                # The start volume of the fit before was worse; what comes next is compared with one from its own.
                without = fit_level(level, factor, confirmed)
            kept = alignment.state()
            told[kind] = fit_level(level, factor, confirmed + names)
            if found := worth_it(without, told[kind]):
                confirmed += names
            else:
                alignment.restore(kept)
        record.append(told)
        logger.info("alignment by pixels joined by %d: %s", factor, alignment.describe())
        if not confirmed and alignment.scanner.geometry.columns // factor >= _ENOUGH:
            break
    alignment.only(confirmed)
    return {"confirmed": list(confirmed), "levels": record}

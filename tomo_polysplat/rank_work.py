"""Work that all ranks do at the same time, each its part, and what becomes of it put together on rank 0.

Rank 0 tells the others by a message "work", with a function of a module and what it gets after the ranks.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch

from tomo_polysplat.ranks import ALONE, Ranks, current_ranks

__all__ = ["any_lacks", "gathered", "helpers"]


def helpers() -> Ranks:
    """The ranks that a part of something can be given to at once; `ALONE` where there are none.

    Nobody waits for processes that have still to start, and none is asked after an interrupt amid a step.
    """
    ranks = current_ranks()
    if ranks.count == 1 or not ranks.usable:
        return ALONE
    # On CPUs, whose runs are the same to the bit, nothing may depend on how soon processes start.
    timed = ranks.device.type == "cuda" and ranks.all_here is not None
    return ranks if ranks.connect is None or (timed and ranks.all_here()) else ALONE


def gathered(ranks: Ranks, tensors: Sequence[torch.Tensor]) -> list[list[torch.Tensor]]:
    """On rank 0 the tensors of each rank, in the order of these; on the others nothing, as they send theirs.

    Those of one place are of one type on one kind of device, and differ in their first length alone.
    """
    lengths = torch.tensor([len(tensor) for tensor in tensors])
    if ranks.rank:
        ranks.send([lengths, *tensors])
        return []
    found = [list(tensors)]
    for rank in range(1, ranks.count):
        theirs = torch.empty_like(lengths)
        ranks.receive([theirs], rank)
        found.append([t.new_empty((n, *t.shape[1:])) for n, t in zip(theirs.tolist(), tensors)])
        ranks.receive(found[-1], rank)
    return found


def any_lacks(ranks: Ranks, lacks: bool) -> bool:
    """Whether any rank lacks what its part takes; all of them ask at the same time, and go on alike."""
    return ranks.total(float(lacks))[0] > 0

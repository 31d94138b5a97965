"""A rank that follows: it makes its part of the steps that rank 0 tells it to make."""

from __future__ import annotations

import os
import signal
import sys
import threading
from contextlib import suppress
from typing import Any

import torch
import torch.distributed as dist

from tomo_polysplat.fit.choose_step import NoRoom, own_step
from tomo_polysplat.fit.led_step import of_all, of_all_moments, of_each, of_each_moment
from tomo_polysplat.fit.lent_rays import borrowed
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.fit.shares import Part
from tomo_polysplat.fit.step import Step
from tomo_polysplat.kernels.device import one_torch_thread, pick_device, usual_modes
from tomo_polysplat.model.gaussians import OF_ALL, Gaussians
from tomo_polysplat.parallel import kept_threads
from tomo_polysplat.quiet_imports import ending_quickly
from tomo_polysplat.rank_processes import here, rank_of_torchrun
from tomo_polysplat.ranks import Ranks, join, join_here, leave
from tomo_polysplat.start.astra_pair import astra_has_gpu

__all__ = ["follow", "follow_torchrun"]


class _Followed:
    """A step of this rank's part of the Gaussians."""

    def __init__(
        self,
        number_of_rays: int,
        projections: torch.Tensor,
        about: dict[str, Any],
        ranks: Ranks,
        beside: Step | None = None,
    ) -> None:
        self.number_of_rays, self.ranks = number_of_rays, ranks
        self.gaussians = _received(about["gaussians"], about["counts"][ranks.rank], ranks)
        self.rays = borrowed(projections, about["rays"], ranks)
        setup = FitSetup(self.gaussians, about["spacing"], self.rays, about["scene"], about["settings"])
        part = Part(ranks, about["planes"][ranks.rank], ranks.device)
        self.step: Step = own_step(setup, about["batch"], ranks, beside, part)

    @torch.no_grad()
    def restore(self, done: int, rates: Any, common: list[list[torch.Tensor]], of_moments: bool) -> None:
        """Go on from where rank 0 is."""
        moments = self.step.moments
        for own, told in zip([*of_all(self.gaussians), *of_all_moments(moments)], sum(common, [])):
            own.copy_(told)
        self.ranks.receive([*of_each(self.gaussians), self.step.pull])
        if of_moments:
            self.ranks.receive(of_each_moment(moments))
        self.step.done = done
        if rates is not None:
            self.step.set_rates(rates)

    def read(self) -> None:
        """Tell rank 0 what has become of the Gaussians."""
        self.step.read()
        self.ranks.send([*of_each(self.gaussians), self.step.pull])


def _received(kinds: Gaussians, count: int, ranks: Ranks) -> Gaussians:
    """Gaussians that rank 0 sends, of whose ``kinds`` it has told."""
    each = {name: tensor.new_empty((count, *tensor.shape[1:])) for name, tensor in kinds.each().items()}
    ranks.receive(each.values())
    return Gaussians(**each, **{name: getattr(kinds, name) for name in OF_ALL})


def follow(ranks: Ranks) -> None:
    """Do what rank 0 tells, until it says that all is done."""
    with usual_modes(), one_torch_thread(ranks.device), kept_threads():
        _follow(ranks)


def _follow(ranks: Ranks) -> None:
    steps: dict[int, _Followed] = {}
    lent: dict[int, torch.Tensor] = ranks.lent
    while True:
        gone, (what, *told) = ranks.hear()
        for number in gone:
            steps.pop(number, None)
            lent.pop(number, None)
        if what == "end":
            return
        if what == "work":
            # What it gets is let go of with it.
            told.pop(0)(ranks, *_taken(told))
            continue
        number, *parts = told
        if what == "rays":
            _take(number, parts[0], lent, steps)
        elif what == "make":
            other = steps.get(parts[1]["beside"])
            beside = None if other is None else other.step
            # All ranks know of it, and rank 0 says what becomes of it.
            with suppress(NoRoom):
                steps[number] = _Followed(parts[0], lent[parts[0]], parts[1], ranks, beside)
            # Nothing that is gone is to be held until the next message.
            other = beside = None
        elif what == "state":
            steps[number].restore(*parts)
        elif what == "step":
            steps[number].step(*parts)
        elif what == "read":
            steps[number].read()
        elif what == "moments":
            ranks.send(of_each_moment(steps[number].step.moments))


def _taken(values: list[Any]) -> list[Any]:
    """The values, of which the list then holds none."""
    taken = values[:]
    values.clear()
    return taken


def _take(
    number: int, told: torch.Tensor, lent: dict[int, torch.Tensor], steps: dict[int, _Followed]
) -> None:
    """Measured rays, new ones or what has become of those that are here."""
    if number not in lent:
        lent[number] = told
        return
    lent[number].copy_(told)
    for followed in steps.values():
        if followed.number_of_rays == number:
            followed.rays.weigh_anew()


def follow_torchrun(device: str) -> None:
    """Follow the first of torchrun's processes, as another one of them.

    Raises
    ------
    RankFailed
        Whatever this one fails of; that rank 0 has gone is no failure.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    ranks = rank_of_torchrun(device)
    try:
        _begin(ranks)
        join(ranks)
        follow(ranks)
    except Exception as error:
        if not ranks.left_alone():
            raise ranks.fail(error) from error
    finally:
        leave()


def main(folder: str, rank: str, count: str, device: str) -> int:
    """A process that rank 0 has started, which it does not outlive."""
    ending_quickly()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    store = dist.FileStore(os.path.join(folder, "store"), int(count))
    ranks = Ranks(int(rank), int(count), torch.device(device), store)
    try:
        _begin(ranks)
        store.set(here(ranks.rank), "1")
        join_here(ranks)
        follow(ranks)
    except BaseException as error:
        # Rank 0 tells it; this process has nobody to tell.
        ranks.fail(error)
        os._exit(1)
    finally:
        leave()
    return 0


def _begin(ranks: Ranks) -> None:
    if pick_device(ranks.device).type == "cuda":
        torch.cuda.set_device(ranks.device)
        _load(ranks.device)


def _load(device: torch.device) -> None:
    """What takes a second or two and is needed anyway, while rank 0 reads: the driver's context, and modules."""
    torch.zeros(1, device=device)
    astra_has_gpu()
    with suppress(ImportError):
        import tomo_polysplat.fit.graph_step  # noqa: F401


def _end_with_parent() -> None:
    # The other end of this pipe closes when rank 0 is no more, however it ended.
    while os.read(0, 1):
        pass
    os._exit(1)


if __name__ == "__main__":
    sys.exit(main(*sys.argv[1:]))

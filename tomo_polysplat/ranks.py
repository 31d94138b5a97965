"""Processes that make the steps of one fit together, each on a device of its own, through torch.distributed.

Rank 0 leads. It alone reads, decides, draws random numbers, asks the clock and writes; the others follow. Before
anything is made together it tells them what (`Ranks.tell`, `Ranks.hear`), and what all of them sum up
(`Ranks.sum_`, `Ranks.total`) comes out the same on each, to the last bit.
"""

from __future__ import annotations

import io
import os
import pickle
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from dataclasses import dataclass, field
from datetime import timedelta
from typing import Any

import torch
import torch.distributed as dist

__all__ = ["ALONE", "RankFailed", "Ranks", "current_ranks", "join", "join_here", "leave", "led_by", "part_of"]

# Bytes of a message that travels at once; of a longer one the rest follows.
_MESSAGE = 4096
# More numbers than this are added up where they are: to put them together would take longer than some more calls.
_LARGE = 1 << 22
# A rank waits for what the first one reads or decides meanwhile. One that dies is noticed by its connection.
_PATIENCE = timedelta(days=30)
# Seconds in which a rank that has failed says why.
_LAST_WORDS = 5.0
# Under which a rank that fails leaves its words, and rank 0 that it waits for nobody any more.
_FAILED, _LEFT = "tomo_polysplat/failed", "tomo_polysplat/left"


class RankFailed(RuntimeError):
    """One of the processes that make a fit together has failed, so that the fit has ended."""


@dataclass(eq=False)
class Ranks:
    """The processes of a fit, as one of them sees them; `ALONE` is the only one there is, and its calls do nothing.

    Attributes
    ----------
    rank, count : int
        Number of this process, from 0 on, and of them all.
    device : torch.device
        Of this one.
    store : torch.distributed.Store or None
        Where a rank that fails says why.
    watch : callable or None
        Tells why a process that rank 0 has started has ended, where one has.
    lent : dict
        Which large tensors the others hold, for whom that concerns; on another rank these, by their number.
    failed : RankFailed or None
        What another rank has failed of, once that is known.
    connect : callable or None
        Called before the first thing is made together.
    all_here : callable or None
        Tells, before that, whether all processes have started, where that is known.
    """

    rank: int = 0
    count: int = 1
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    store: Any = None
    watch: Any = None
    lent: dict[int, Any] = field(default_factory=dict)
    failed: RankFailed | None = None
    connect: Any = None
    all_here: Any = None
    _made: int = 0
    _gone: list[int] = field(default_factory=list)
    _broken: bool = False

    def sum_(self, *tensors: torch.Tensor) -> None:
        """Add up contiguous tensors of one type over all ranks, in place."""
        if self.count == 1:
            return
        if sum(tensor.numel() for tensor in tensors) > _LARGE:
            for tensor in filter(torch.Tensor.numel, tensors):
                dist.all_reduce(tensor)
            return
        flat = torch.cat([tensor.reshape(-1) for tensor in tensors])
        dist.all_reduce(flat)
        for tensor, total in zip(tensors, flat.split([tensor.numel() for tensor in tensors])):
            tensor.copy_(total.view_as(tensor))

    def total(self, *numbers: float) -> list[float]:
        """Numbers added up over all ranks."""
        return list(numbers) if self.count == 1 else self._reduced(list(numbers), dist.ReduceOp.SUM)

    def same(self, number: int) -> bool:
        """Whether all ranks have the same number."""
        if self.count == 1:
            return True
        # Whole numbers below 2^53 are exact.
        most, least = self._reduced([float(number), -float(number)], dist.ReduceOp.MAX)
        return most == -least

    def _reduced(self, numbers: list[float], how: Any) -> list[float]:
        values = torch.tensor(numbers, dtype=torch.float64)
        dist.all_reduce(values, op=how)
        return values.tolist()

    def number(self) -> int:
        """A new number for something that all ranks hold."""
        self._made += 1
        return self._made

    def let_go(self, number: int) -> None:
        """Tell the others, with the next message, that what has this number is not needed any more."""
        self._gone.append(number)

    def tell(self, *message: Any) -> None:
        """From rank 0, what `hear` returns on all others; tensors in it arrive on the device that is theirs."""
        gone, self._gone = self._gone, []
        tensors: list[torch.Tensor] = []
        body = io.BytesIO()
        _Pickler(body, tensors).dump((gone, message))
        kinds = [(tuple(t.shape), t.dtype, t.device.type == self.device.type) for t in tensors]
        text = pickle.dumps((body.getvalue(), kinds))
        whole = torch.frombuffer(bytearray(len(text).to_bytes(8, "little") + text), dtype=torch.uint8)
        first = torch.zeros(_MESSAGE, dtype=torch.uint8)
        first[: min(len(whole), _MESSAGE)] = whole[:_MESSAGE]
        dist.broadcast(first, 0)
        if len(whole) > _MESSAGE:
            dist.broadcast(whole[_MESSAGE:].clone(), 0)
        for tensor in filter(torch.Tensor.numel, tensors):
            dist.broadcast(tensor, 0)

    def hear(self) -> tuple[list[int], tuple[Any, ...]]:
        """What rank 0 tells: the numbers of what may be let go of, and the message."""
        first = torch.empty(_MESSAGE, dtype=torch.uint8)
        dist.broadcast(first, 0)
        parts, left = [first], 8 + int.from_bytes(first[:8].numpy().tobytes(), "little") - _MESSAGE
        if left > 0:
            parts.append(torch.empty(left, dtype=torch.uint8))
            dist.broadcast(parts[1], 0)
        text = torch.cat(parts).numpy().tobytes()
        # Only from rank 0, which this process belongs to.
        body, kinds = pickle.loads(text[8:])  # noqa: S301
        tensors = []
        for shape, kind, on_device in kinds:
            tensors.append(torch.empty(shape, dtype=kind, device=self.device if on_device else "cpu"))
            if tensors[-1].numel():
                dist.broadcast(tensors[-1], 0)
        return _Unpickler(io.BytesIO(body), tensors).load()

    def send(self, tensors: Iterable[torch.Tensor], rank: int = 0) -> None:
        """To one rank what it takes by `receive`."""
        for tensor in filter(torch.Tensor.numel, tensors):
            _wait_for(dist.isend, tensor.detach().contiguous(), rank)

    def receive(self, tensors: Iterable[torch.Tensor], rank: int = 0) -> None:
        """From one rank, into contiguous tensors of the same shapes and types as those sent."""
        for tensor in filter(torch.Tensor.numel, tensors):
            _wait_for(dist.irecv, tensor.detach(), rank)

    @contextmanager
    def together(self) -> Iterator[None]:
        """Make something that all ranks take part in.

        Raises
        ------
        RankFailed
            If another rank has failed, or this block was once left before its end: then the others wait for what
            never comes, and nothing more is made together.
        """
        if self._broken:
            raise self.failed or RankFailed("the other ranks were left in the middle of a step")
        self._broken = True
        try:
            connect, self.connect = self.connect, None
            if connect is not None:
                connect()
            yield
        except Exception as error:
            self.failed = self.failed or self.failure(_LAST_WORDS)
            if self.failed is None:
                raise
            raise self.failed from error
        if self.failed is not None:
            raise self.failed
        self._broken = False

    @property
    def usable(self) -> bool:
        """Whether more can be made together."""
        return not self._broken

    def failure(self, patience: float = 0.0) -> RankFailed | None:
        """What another rank has failed of; None if nobody says so within these seconds."""
        end = time.monotonic() + patience
        while self.count > 1:
            words = self._last_words() or (self.watch() if self.watch is not None else None)
            if words:
                return RankFailed(words)
            if time.monotonic() >= end:
                break
            time.sleep(0.05)
        return None

    def _last_words(self) -> str:
        with suppress(RuntimeError):  # the store may have gone with the process that kept it
            if self.store is not None and self.store.check([_FAILED]):
                return self.store.get(_FAILED).decode()
        return ""

    def fail(self, error: BaseException) -> RankFailed:
        """Say, for rank 0 to repeat, what this one has failed of."""
        reason = f"{type(error).__name__}: {' '.join(str(error).split())}"
        words = f"rank {self.rank} of {self.count} ({self.device}) failed: {reason}"
        with suppress(RuntimeError):
            self.store.set(_FAILED, words)
        return RankFailed(words)

    def leave(self) -> None:
        """From rank 0, that it goes, so that the others need not complain of it."""
        with suppress(RuntimeError):
            self.store.set(_LEFT, "1")

    def left_alone(self) -> bool:
        """Whether rank 0 has gone."""
        with suppress(RuntimeError):
            return self.store.check([_LEFT])
        return False


def _wait_for(what: Any, tensor: torch.Tensor, rank: int) -> None:
    # As a batch: NCCL goes through the connections that there are, in place of new ones of two ranks with buffers.
    for work in dist.batch_isend_irecv([dist.P2POp(what, tensor, rank)]):
        work.wait()


def part_of(length: int, rank: int, count: int) -> slice:
    """A rank's part of ``range(length)``; empty where there are too few for all."""
    return slice(length * rank // count, length * (rank + 1) // count)


ALONE = Ranks()
_CURRENT: ContextVar[Ranks] = ContextVar("_CURRENT", default=ALONE)


def current_ranks() -> Ranks:
    """Those that the steps of a fit are shared out over, here and now."""
    return _CURRENT.get()


@contextmanager
def led_by(ranks: Ranks) -> Iterator[None]:
    """Share the steps of fits within out over these."""
    before = _CURRENT.set(ranks)
    try:
        yield
    finally:
        _CURRENT.reset(before)


def join(ranks: Ranks) -> None:
    """Connect with all others, which do the same."""
    on_gpu = ranks.device.type == "cuda"
    ranks.store.set_timeout(_PATIENCE)
    # Whether another rank has died is found out here; NCCL's own watch would end this process.
    with _variables({"TORCH_NCCL_ASYNC_ERROR_HANDLING": "0"}):
        dist.init_process_group(
            "cpu:gloo,cuda:nccl" if on_gpu else "gloo",
            store=dist.PrefixStore("tomo_polysplat/group", ranks.store),
            rank=ranks.rank,
            world_size=ranks.count,
            timeout=_PATIENCE,
        )
        # NCCL connects when it is first used, which would otherwise be beside a graph that is recorded.
        dist.all_reduce(torch.zeros(1, device=ranks.device))


def join_here(ranks: Ranks) -> None:
    """Connect with others of this host: no other has to reach them, nor has this one's name to be known."""
    with _variables({"GLOO_SOCKET_IFNAME": "lo"} if sys.platform == "linux" else {}):
        join(ranks)


@contextmanager
def _variables(values: dict[str, str]) -> Iterator[None]:
    """Variables of the environment, while libraries look at them; what the caller has set stands."""
    own = {name: value for name, value in values.items() if name not in os.environ}
    os.environ.update(own)
    try:
        yield
    finally:
        for name in own:
            os.environ.pop(name, None)


def leave() -> None:
    """Let go of the connections without waiting for anybody."""
    # To destroy a group waits for what was begun with processes that may be no more. Of two threads one is too late.
    abort = getattr(dist.distributed_c10d, "_abort_process_group", dist.destroy_process_group)
    with suppress(Exception):
        if dist.is_initialized():
            abort()


class _Pickler(pickle.Pickler):
    """Leaves tensors out, for them to be sent by themselves."""

    def __init__(self, file: io.BytesIO, tensors: list[torch.Tensor]) -> None:
        super().__init__(file)
        self._tensors = tensors

    def persistent_id(self, value: Any) -> int | None:
        """Place of a tensor among those left out."""
        if not isinstance(value, torch.Tensor):
            return None
        self._tensors.append(value.detach().contiguous())
        return len(self._tensors) - 1


class _Unpickler(pickle.Unpickler):
    """Puts them back."""

    def __init__(self, file: io.BytesIO, tensors: list[torch.Tensor]) -> None:
        super().__init__(file)
        self._tensors = tensors

    def persistent_load(self, place: int) -> torch.Tensor:
        """The tensor of this place."""
        return self._tensors[place]

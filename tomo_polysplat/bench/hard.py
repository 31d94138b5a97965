"""Hard cases one after the other, each watched: a crash or a hang of one is its failure and nobody else's."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict
from typing import Any

import torch

from tomo_polysplat.bench.environment import environment
from tomo_polysplat.bench.hard_cases import (
    arrays,
    easy,
    gaussians,
    objects,
    precision,
    rays,
    scanner,
    spectra,
    views,
    voxels,
)
from tomo_polysplat.bench.hard_cases.case import Case
from tomo_polysplat.bench.hard_process import Worker
from tomo_polysplat.checks import fail, require_choice

__all__ = ["HARD_CASES", "chosen_cases", "run_hard_bench"]

_MODULES = (easy, rays, views, scanner, voxels, arrays, objects, spectra, gaussians, precision)
HARD_CASES: dict[str, Case] = {case.name: case for module in _MODULES for case in module.CASES}

Record = dict[str, Any]


def chosen_cases(only: Iterable[str] = ()) -> list[Case]:
    """The cases of these names, or all, in the order of the table."""
    names = {require_choice("only", name, HARD_CASES) for name in only}
    return [case for case in HARD_CASES.values() if not names or case.name in names]


def run_hard_bench(
    device: str = "cpu",
    cases: Sequence[Case] | None = None,
    *,
    progress: Callable[[str], Any] = lambda _: None,
    update: Callable[[Record], Any] = lambda _: None,
) -> Record:
    """Run cases in a process of their own.

    Parameters
    ----------
    device : str
    cases : sequence of Case, optional
        None for all.
    progress : callable
        Told the name of the case that comes next.
    update : callable
        Given the record after every case, so that an interrupted run leaves something.

    Returns
    -------
    dict
        JSON-able: ``device``, ``environment`` and ``cases``, each with ``name``, ``why``, ``passed``,
        ``seconds``, ``error`` (empty, or what was raised, hung or crashed) and ``findings``
        (:class:`~tomo_polysplat.bench.hard_cases.case.Findings`).
    """
    if device.startswith("cuda") and not torch.cuda.is_available():
        raise fail("device", "a device that is there", repr(device), "torch finds no CUDA device")
    record: Record = {"device": device, "environment": environment(), "cases": []}
    with Worker(device) as worker:
        for case in chosen_cases() if cases is None else cases:
            progress(case.name)
            outcome = worker.run(case)
            record["cases"].append({"name": case.name, "why": case.why, **asdict(outcome)})
            update(record)
    return record

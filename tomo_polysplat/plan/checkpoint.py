"""A fit in a file, from which an interrupted run goes on as if nothing had happened.

The file is an ``.npz`` archive without pickled objects: the Gaussians with the optimiser's memory of them, the
best ones so far, and in ``about`` (JSON in UTF-8) the plan, the random numbers' state, the history, and what
scan and options all that belongs to.
"""

from __future__ import annotations

import hashlib
import json
import logging
import os
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch

from tomo_polysplat.checks import fail
from tomo_polysplat.file_lock import FileLock
from tomo_polysplat.files import replacing, require_replaceable, require_writable
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.snapshot import Snapshot
from tomo_polysplat.fit.taken_out import Step
from tomo_polysplat.plan.checkpoint_content import (
    DAMAGES,
    NAMES,
    content_of,
    plan_of,
    snapshot_of,
    taken_of,
)
from tomo_polysplat.plan.light_told import EARLY_LIGHT
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.scan.archive import read_archive

__all__ = ["Checkpoint"]

logger = logging.getLogger(__name__)

FORMAT = 19
# Writing takes at most this share of the time.
_LARGEST_SHARE = 0.05


class Checkpoint:
    """The file of one run.

    Parameters
    ----------
    path : path
    problem : Problem
        The scan.
    options : mapping
        Everything else that the result depends on, in what JSON can hold.
    resume : bool
        Go on from the file if it exists; without it a file that exists is refused.

    Raises
    ------
    FileExistsError
        If the file exists and ``resume`` is false.
    ValueError
        If it is damaged, or belongs to another scan or to other options.
    OSError
        If it could not be written.
    """

    def __init__(
        self, path: str | os.PathLike, problem: Problem, options: Mapping[str, Any], *, resume: bool
    ) -> None:
        remedy = "pass resume=True to go on from it, or remove it"
        self.path = require_replaceable(path, resume, remedy, "checkpoint")
        require_writable(self.path.parent)
        self._lock = FileLock(self.path, "checkpoint")
        # Another run may have written it and ended since.
        require_replaceable(self.path, resume, remedy, "checkpoint")
        self._views, self._pixels = len(problem.projections), problem.projections.shape
        self.scan, self.options = _digest(problem), json.loads(json.dumps(dict(options)))
        self.plan: Plan | None = None
        self.snapshot: Snapshot | None = None
        self._taken: list[Step] = []
        self._written, self._took = 0.0, 0.0
        if self.path.exists():
            self._read()

    @property
    def seconds(self) -> float:
        """What the run has taken so far."""
        return 0.0 if self.snapshot is None else self.snapshot.numbers["seconds"]

    def share_early(self, problem: Problem, device: torch.device) -> None:
        """Take out of what was measured what was taken out before the questions, as one step."""
        if self.plan is not None and EARLY_LIGHT in self.plan.facts and self._taken:
            # There have to be copies to take it out of.
            problem.measured(device)
            problem.taken.add(*self._taken[0])
            # As the run did, which had been told of the noise before.
            problem.forget_told()

    def share_taken(self, problem: Problem) -> None:
        """Take out of what was measured what the run had taken out, and keep what it will, from now on."""
        for gains, drift in self._taken[len(problem.taken.steps) :]:
            problem.taken.add(gains, drift)
        self._taken = problem.taken.steps

    def offer(self, make: Callable[[], Snapshot], *, now: bool) -> None:
        """Write what ``make`` returns, unless that has only just been done; ``now`` writes it in any case.

        A disk that fills up in the middle of a run does not end the run: the last file that was complete stays.
        """
        begun = time.perf_counter()
        if not now and (begun - self._written) * _LARGEST_SHARE < self._took:
            return
        try:
            self._write(make())
        except OSError as error:
            logger.warning("The checkpoint was not written, and the run goes on: %s", error)
        self._written = time.perf_counter()
        self._took = self._written - begun

    def _write(self, snapshot: Snapshot) -> None:
        assert self.plan is not None
        about = {"format": FORMAT, "scan": self.scan, "options": self.options, "plan": self.plan.to_dict()}
        text = json.dumps(about | {"numbers": snapshot.numbers}, default=str)
        arrays = snapshot.arrays() | {"about": np.frombuffer(text.encode(), np.uint8)}
        for name, parts in zip(("taken/gains", "taken/drift"), zip(*self._taken)):
            arrays[name] = np.stack(parts)
        needed = sum(array.nbytes for array in arrays.values())
        with (
            replacing(self.path, overwrite=True, needed_bytes=needed) as temporary,
            open(temporary, "wb") as file,
        ):
            np.savez(file, **arrays)  # type: ignore[arg-type]  # its stubs know only NumPy 2.1 and later

    def _read(self) -> None:
        arrays = read_archive(self.path, NAMES, compressed=False)
        try:
            about = content_of(arrays["about"])
            self._require_same(about)
            self.plan = plan_of(about["plan"], self.options)
            self._taken = taken_of(arrays, self._pixels)
            self.snapshot = snapshot_of(arrays, about["numbers"], self._views)
        except DAMAGES as error:
            raise self._damaged(f"{type(error).__name__} {error}") from error
        logger.info("Going on after %s steps from %s", self.snapshot.numbers.get("steps"), self.path)

    def _damaged(self, why: str) -> Exception:
        return fail("checkpoint", "a complete checkpoint", f"{self.path} ({why})", "remove it and begin anew")

    def _require_same(self, about: dict[str, Any]) -> None:
        remedy = "remove the file or name another one"
        if about["format"] != FORMAT:
            raise fail("checkpoint", f"a file of format {FORMAT}", f"{about['format']!r}", remedy)
        if about["scan"] != self.scan:
            got = f"{self.path}, which another scan, spectrum, list of materials or filter map left behind"
            raise fail("checkpoint", "one of this scan, and of how it is modelled", got, remedy)
        names = sorted(self.options.keys() | about["options"].keys())
        other = [name for name in names if self.options.get(name) != about["options"].get(name)]
        if other:
            mine, its = (
                {name: known.get(name) for name in other} for known in (self.options, about["options"])
            )
            raise fail("checkpoint", f"one made with {mine}", f"{its} in {self.path}", remedy)


def _digest(problem: Problem) -> str:
    """What tells this scan, in these coordinates, from any other."""
    geometry, grid = problem.geometry, problem.grid
    spectrum, materials = problem.spectrum, problem.materials
    digest = hashlib.sha256()
    arrays = [problem.projections, geometry.origin, geometry.corner, geometry.u, geometry.v]
    arrays += [np.array(grid.shape), grid.lower, grid.upper, problem.centre]
    if spectrum is not None and materials is not None:
        arrays += [spectrum.energies, spectrum.weights, materials.mass_attenuation(spectrum.energies)]
    if problem.filter_map is not None:
        digest.update(problem.filter_map.material.encode())
        arrays.append(problem.filter_map.areal)
    for array in arrays:
        digest.update(f"{array.shape}{array.dtype}".encode())
        digest.update(np.ascontiguousarray(array).data)
    digest.update(repr((geometry.beam, float(problem.length), float(problem.depth), problem.planar)).encode())
    return digest.hexdigest()

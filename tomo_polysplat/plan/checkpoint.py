"""A fit in a file, from which an interrupted run goes on as if nothing had happened.

The file is an ``.npz`` archive without pickled objects: the Gaussians with the optimiser's memory of them, the
best ones so far, and in ``about`` (JSON in UTF-8) the plan, the random numbers' state, the history, and what
scan and options all that belongs to.
"""

from __future__ import annotations

import hashlib
import json
import logging
import math
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
from tomo_polysplat.fit.snapshot import PARTS, Snapshot
from tomo_polysplat.fit.stopping import StopReason
from tomo_polysplat.fit.taken_out import Step
from tomo_polysplat.json_text import parse_json
from tomo_polysplat.model.gaussians import OF_ALL, Gaussians
from tomo_polysplat.nuisances.drift import Drift
from tomo_polysplat.nuisances.gains import Gains
from tomo_polysplat.plan.decision import When
from tomo_polysplat.plan.order import ORDER
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.scan.archive import read_archive
from tomo_polysplat.scan.moves import MOVES

__all__ = ["Checkpoint"]

logger = logging.getLogger(__name__)

FORMAT = 19
# Writing takes at most this share of the time.
_LARGEST_SHARE = 0.05
# Of any parameter of a Gaussian; lengths are in those of the object, and the square of a material number is taken.
_LARGEST = 1e6
_FITTED = tuple(name for name in PARTS if name != "group")
# What taking apart something else than the expected raises.
_DAMAGES = (KeyError, IndexError, TypeError, AttributeError, RecursionError, OverflowError)
_NAMES = (
    *(f"{kind}/{name}" for kind in ("gaussians", "best") for name in PARTS),
    *(f"{moment}/{name}" for moment in ("first", "second") for name in _FITTED),
    *("pull", "order", "about", "taken/gains", "taken/drift"),
)


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

    def share_taken(self, problem: Problem) -> None:
        """Take out of what was measured what the run had taken out, and keep what it will, from now on."""
        for gains, drift in self._taken:
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
        arrays = read_archive(self.path, _NAMES, compressed=False)
        try:
            about = _content(arrays["about"])
            self._require_same(about)
            self.plan = _plan(about["plan"])
            _require_calibration(self.plan, self.options.get("calibration"))
            _require_moves(self.plan, self.options.get("align"))
            _require_light(self.plan)
            self._taken = _taken(arrays, self._pixels)
            self.snapshot = _snapshot(arrays, about["numbers"], self._views)
        except _DAMAGES as error:
            raise self._damaged(f"{type(error).__name__} {error}") from error
        logger.info("Going on after %s steps from %s", self.snapshot.numbers.get("steps"), self.path)

    def _damaged(self, why: str) -> Exception:
        return fail("checkpoint", "a complete checkpoint", f"{self.path} ({why})", "remove it and begin anew")

    def _require_same(self, about: dict[str, Any]) -> None:
        remedy = "remove the file or name another one"
        if about["format"] != FORMAT:
            raise fail("checkpoint", f"a file of format {FORMAT}", f"{about['format']!r}", remedy)
        if about["scan"] != self.scan:
            raise fail(
                "checkpoint", "one of this scan", f"{self.path}, which another scan left behind", remedy
            )
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


def _content(about: np.ndarray) -> dict[str, Any]:
    try:
        # The least loss so far may be infinite.
        return parse_json(about.tobytes().decode("utf-8"), "about", finite=False)
    except ValueError as error:
        raise TypeError(f"no JSON: {error}") from error


def _plan(parts: dict[str, Any]) -> Plan:
    plan = Plan.from_dict(parts)
    if unknown := sorted(plan.answers.keys() - {kind.name for kind in ORDER}):
        raise TypeError(f"answers to known questions, got one to {', '.join(unknown)}"[:200])
    for kind in ORDER:
        missing = kind.name not in plan.answers
        if missing and kind.when is not When.DURING:
            raise TypeError(f"an answer to {kind.name}")
        if not missing and not kind().valid(plan.answers[kind.name].value):
            raise TypeError(f"an answer to {kind.name}, got {plan.answers[kind.name].value!r}")
    return plan


def _require_calibration(plan: Plan, asked: Any) -> None:
    if not isinstance(asked, dict) and "calibration" not in plan.facts:
        return
    found = plan.facts["calibration"].value
    fitted, accepted = found["fitted"], found["accepted"]
    numbers = all(isinstance(value, float) and math.isfinite(value) for value in fitted.values())
    if not (numbers and isinstance(accepted, dict)):
        raise TypeError(f"what the calibration found, got {found}")


def _require_moves(plan: Plan, asked: Any) -> None:
    """See to it that a plan tells the moves of the scanner where they were asked about."""
    if asked is None:
        return
    moves = plan.facts["alignment"].value
    for name, value in moves.items():
        numbers = value if isinstance(value, list) else [value]
        if name not in MOVES or not _finite(numbers):
            raise TypeError(f"moves of the scanner, got {name} = {value!r}"[:200])


def _require_light(plan: Plan) -> None:
    """See to it that what it tells of gains and drift are numbers."""
    for name in (Drift.name, Gains.name):
        told = plan.facts.get(name)
        if told is not None and not _finite([told.value, *told.evidence.values()]):
            raise TypeError(f"numbers of {name}, got {told.value!r} by {told.evidence}"[:200])


def _finite(values: list[Any]) -> bool:
    """Whether a list, of lists perhaps, holds finite numbers alone."""
    return all(
        _finite(v) if isinstance(v, list) else type(v) in (int, float) and math.isfinite(v) for v in values
    )


def _taken(arrays: dict[str, np.ndarray], rays: tuple[int, ...]) -> list[Step]:
    """Gains and drift that had been taken out, in their order."""
    if "taken/gains" not in arrays and "taken/drift" not in arrays:
        return []
    gains, drift = arrays["taken/gains"], arrays["taken/drift"]
    good = gains.shape[1:] == rays[1:] and drift.shape[1:] == rays[:1] and len(gains) == len(drift)
    finite = all(part.dtype == np.float32 and np.isfinite(part).all() for part in (gains, drift))
    if not (good and finite):
        raise TypeError("gains and drift")
    return list(zip(gains, drift))


def _snapshot(arrays: dict[str, np.ndarray], numbers: dict[str, Any], views: int) -> Snapshot:
    """The snapshot of a file, its parts checked against each other."""
    gaussians = _cloud(arrays, "gaussians", arrays["gaussians/attenuation"].shape)
    # The best state may be of before the cloud has grown.
    best = _cloud(arrays, "best", arrays["best/attenuation"].shape) if "best/position" in arrays else None
    shapes = {name: tuple(tensor.shape) for name, tensor in gaussians.parameters().items()}
    first, second = (
        {name: _tensor(arrays[f"{kind}/{name}"], shape) for name, shape in shapes.items()}
        for kind in ("first", "second")
    )
    pull = _tensor(arrays["pull"], shapes["attenuation"])
    order = arrays["order"]
    if order.ndim != 1 or order.dtype.kind != "i" or ((order < 0) | (order >= views)).any():
        raise TypeError("order of the views")
    _require_numbers(numbers)
    return Snapshot(gaussians, best, first, second, pull, order, numbers)


def _require_numbers(numbers: dict[str, Any]) -> None:
    if not isinstance(numbers, dict):
        raise TypeError(f"the numbers of a run, got {numbers!r}"[:200])
    counts = ("steps", "steps_made", "pace", "skipped_pairs", "relocated", "most")
    if any(not isinstance(numbers[name], int) or numbers[name] < 0 for name in counts):
        raise TypeError(f"whole numbers for {', '.join(counts)}")
    if any(not math.isfinite(numbers[name]) for name in ("seconds", "begun")):
        raise TypeError("finite times")
    largest, history = numbers["largest"], numbers["history"]
    if not isinstance(largest, list) or len(largest) not in (0, 2) or not all(map(math.isfinite, largest)):
        raise TypeError("the largest sums")
    if not isinstance(history, list):
        raise TypeError("a history")
    if (stop := numbers["stop"]) is not None:
        reasons = [known.value for known in StopReason]
        if len(stop) != 2 or stop[0] not in reasons or not isinstance(stop[1], str):
            raise TypeError(f"what ended the run, got {stop}")
    for entry in history:
        if not (isinstance(entry["loss"], float) and isinstance(entry["held_out"], (float, type(None)))):
            raise TypeError("errors of every pass")
    try:
        np.random.default_rng().bit_generator.state = numbers["random"]
    except ValueError as error:
        raise TypeError(f"random numbers: {error}") from error


def _cloud(arrays: dict[str, np.ndarray], kind: str, count: tuple[int, ...]) -> Gaussians:
    """Gaussians of the file, ``count`` (n,) of them."""
    dims, groups = arrays[f"{kind}/log_scale"].shape[-1], arrays[f"{kind}/shared_material"].shape[-1]
    tails: dict[str, tuple[int, ...]] = {"position": (3,), "log_scale": (dims,), "rotation": (4,)}
    parts = {
        name: _tensor(arrays[f"{kind}/{name}"], (*count, *tails.get(name, ())))
        for name in _FITTED
        if name not in OF_ALL
    }
    whole = {n: _tensor(arrays[f"{kind}/{n}"], s) for n, s in zip(OF_ALL, ((groups,), (1,)))}
    if any((part.abs() > _LARGEST).any() for part in (*parts.values(), *whole.values())):
        raise TypeError(f"{kind} with parameters of at most {_LARGEST:g}")
    group = arrays[f"{kind}/group"]
    indices = group.dtype == np.int64 and group.shape == count
    if len(count) != 1 or dims not in (2, 3) or not indices or (group < -1).any() or (group >= groups).any():
        raise TypeError(f"{kind} of shape {count}")
    return Gaussians(**parts, **whole, group=torch.from_numpy(group))


def _tensor(array: np.ndarray, shape: tuple[int, ...]) -> torch.Tensor:
    if array.dtype != np.float32 or array.shape != shape or not np.isfinite(array).all():
        raise TypeError(f"finite float32 of shape {shape}, got {array.dtype} of shape {array.shape}")
    return torch.from_numpy(array)

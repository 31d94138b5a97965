"""What the file of a checkpoint holds, each part checked before anything is made of it.

What is wrong raises one of `DAMAGES`, with words for what was expected.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import torch

from tomo_polysplat.fit.snapshot import PARTS, Snapshot
from tomo_polysplat.fit.stopping import StopReason
from tomo_polysplat.fit.taken_out import Step
from tomo_polysplat.json_text import parse_json
from tomo_polysplat.model.gaussians import OF_ALL, Gaussians
from tomo_polysplat.nuisances.bowtie import Bowtie
from tomo_polysplat.nuisances.drift import Drift
from tomo_polysplat.nuisances.gains import Gains
from tomo_polysplat.plan.decision import When
from tomo_polysplat.plan.order import ORDER
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.scan.moves import MOVES

__all__ = ["DAMAGES", "NAMES", "content_of", "plan_of", "snapshot_of", "taken_of"]

# Of any parameter of a Gaussian; lengths are in those of the object, and the square of a material number is taken.
_LARGEST = 1e6
_FITTED = tuple(name for name in PARTS if name != "group")
# What taking apart something else than the expected raises.
DAMAGES = (KeyError, IndexError, TypeError, AttributeError, RecursionError, OverflowError)
NAMES = (
    *(f"{kind}/{name}" for kind in ("gaussians", "best") for name in PARTS),
    *(f"{moment}/{name}" for moment in ("first", "second") for name in _FITTED),
    *("pull", "order", "about", "taken/gains", "taken/drift"),
)


def content_of(about: np.ndarray) -> dict[str, Any]:
    """The object that a text in JSON stands for; ``about`` holds the bytes of its UTF-8."""
    try:
        # The least loss so far may be infinite.
        return parse_json(about.tobytes().decode("utf-8"), "about", finite=False)
    except ValueError as error:
        raise TypeError(f"no JSON: {error}") from error


def plan_of(parts: dict[str, Any], options: dict[str, Any]) -> Plan:
    """The plan of a file, which tells all that a run of these options asks."""
    plan = Plan.from_dict(parts)
    if unknown := sorted(plan.answers.keys() - {kind.name for kind in ORDER}):
        raise TypeError(f"answers to known questions, got one to {', '.join(unknown)}"[:200])
    for kind in ORDER:
        missing = kind.name not in plan.answers
        if missing and kind.when is not When.DURING:
            raise TypeError(f"an answer to {kind.name}")
        if not missing and not kind().valid(plan.answers[kind.name].value):
            raise TypeError(f"an answer to {kind.name}, got {plan.answers[kind.name].value!r}")
    _require_calibration(plan, options.get("calibration"))
    _require_moves(plan, options.get("align"))
    _require_light(plan)
    _require_bowtie(plan, options.get("filter_map"))
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


def _require_bowtie(plan: Plan, asked: Any) -> None:
    """See to it that a plan tells the bowtie where it was asked about."""
    if asked is None:
        return
    found, ends = plan.facts["bowtie"].value, Bowtie.parameters
    good = isinstance(found, dict) and set(found) <= set(ends) and _finite(list(found.values()))
    if not (good and all(ends[name].least <= value <= ends[name].most for name, value in found.items())):
        raise TypeError(f"coefficients of a bowtie, got {found!r}"[:200])


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


def taken_of(arrays: dict[str, np.ndarray], rays: tuple[int, ...]) -> list[Step]:
    """Gains and drift that had been taken out, in their order."""
    if "taken/gains" not in arrays and "taken/drift" not in arrays:
        return []
    gains, drift = arrays["taken/gains"], arrays["taken/drift"]
    good = gains.shape[1:] == rays[1:] and drift.shape[1:] == rays[:1] and len(gains) == len(drift)
    finite = all(part.dtype == np.float32 and np.isfinite(part).all() for part in (gains, drift))
    if not (good and finite):
        raise TypeError("gains and drift")
    return list(zip(gains, drift))


def snapshot_of(arrays: dict[str, np.ndarray], numbers: dict[str, Any], views: int) -> Snapshot:
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

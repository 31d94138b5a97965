"""What rays cannot tell of a scanner's moves, as the object can move or swell instead, and what is left then."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.moves import Scanner
from tomo_polysplat.scan.slopes import slope_at_zero

__all__ = ["Effect", "common_offset", "effects", "view_gauge", "without_gauge"]

# Views, spread over the scan, that tell what a move does.
_VIEWS = 48
# Of the largest singular value: below it a column is a sum of the others.
_RANK = 1e-6


@dataclass(frozen=True)
class Effect:
    """What a move does to where points of the object fall on the detector.

    Attributes
    ----------
    pixels : float
        Root mean square over points and views of a move by one of its unit, in pixels, that no move and no swelling of
        the object makes.
    told : float
        That as a share of the whole: 0 where the object can take the move's place, 1 where it cannot at all.
    """

    pixels: float
    told: float


def effects(scanner: Scanner, names: list[str] | tuple[str, ...], radius: float) -> dict[str, Effect]:
    """What moves of the whole scanner do, to first order, to an object of this radius round the pivot.

    Parameters
    ----------
    scanner : Scanner
    names : names of `MOVES` other than ``views``
    radius : float
        In the unit of the geometry.
    """
    many = scanner.geometry.views
    some = evenly_spread(many, _VIEWS)
    part = Scanner(scanner.geometry.select(some), scanner.pivot.numpy())
    points = _points(radius)
    basis = _orthonormal(_of_object(part, points))
    found = {}
    for name in names:
        slope = slope_at_zero(_falls(part, name, points + part.pivot)).flatten()
        rest = slope - basis @ (basis.T @ slope)
        whole, left = (float(x.square().mean().mul(2).sqrt()) for x in (slope, rest))
        found[name] = Effect(left, left / whole if whole > 0 else 0.0)
    return found


def view_gauge(scanner: Scanner) -> torch.Tensor:
    """(2 views, n) orthonormal shifts of all views, (views, 2) flattened, that are no shifts of single views.

    Those by which all move alike, which are moves of the detector, and those that a move of the object in space makes:
    in an orbit about z the cosine and the sine of the angle along ``u``, and one along ``v``.
    """
    return _orthonormal(_no_single_views(scanner))


def common_offset(shifts: torch.Tensor, scanner: Scanner) -> torch.Tensor:
    """(2,) offset along ``u`` and ``v`` that is in shifts (views, 2), beside what a move of the object explains."""
    columns = _no_single_views(scanner)
    # A lift of the object is all but one of the detector: no large one of each may stand for nothing.
    found = torch.linalg.lstsq(columns, shifts.reshape(-1, 1), rcond=_RANK, driver="gelsd")
    return found.solution[:2, 0]


def without_gauge(shifts: torch.Tensor, gauge: torch.Tensor) -> torch.Tensor:
    """Shifts (views, 2) without what lies in a gauge."""
    flat = shifts.reshape(-1)
    return (flat - gauge @ (gauge.T @ flat)).reshape(shifts.shape)


def _no_single_views(scanner: Scanner) -> torch.Tensor:
    """(2 views, 5) shifts of all views alike along ``u`` and ``v``, and those by moves of the object."""
    alike = torch.eye(2, dtype=torch.float64).repeat(scanner.geometry.views, 1)
    of_object = _of_object(scanner, torch.zeros((1, 3), dtype=torch.float64))[:, :3]
    return torch.cat([alike, of_object], dim=1)


def _falls(scanner: Scanner, name: str, points: torch.Tensor) -> Callable[[torch.Tensor], torch.Tensor]:
    """Where points fall, by how far one move is made."""
    return lambda step: scanner.project({name: step}, points)


def _points(radius: float) -> torch.Tensor:
    """Points of a ball round the origin, the same on every run, (n, 3)."""
    generator = np.random.default_rng(0)
    direction = generator.normal(size=(64, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    return torch.from_numpy(radius * direction * np.cbrt((np.arange(64)[:, None] + 0.5) / 64))


def _of_object(scanner: Scanner, points: torch.Tensor) -> torch.Tensor:
    """(views n 2, 7) shifts on the detector by moving, turning and swelling the object by one, to first order."""
    axes = torch.eye(3, dtype=torch.float64)
    flows = [axis.expand_as(points) for axis in axes]
    flows += [torch.linalg.cross(axis.expand_as(points), points) for axis in axes] + [points]

    def column(flow: torch.Tensor) -> torch.Tensor:
        def falls(step: torch.Tensor) -> torch.Tensor:
            return scanner.project({}, points + step * flow + scanner.pivot)

        return slope_at_zero(falls).flatten()

    return torch.stack([column(flow) for flow in flows], dim=1)


def _orthonormal(columns: torch.Tensor) -> torch.Tensor:
    """An orthonormal basis of what the columns span."""
    lengths = columns.norm(dim=0)
    columns = columns[:, lengths > 0] / lengths[lengths > 0]
    left, singular, _ = torch.linalg.svd(columns, full_matrices=False)
    return left[:, singular > _RANK * singular[0]] if len(singular) else left

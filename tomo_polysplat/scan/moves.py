"""Moves of a scanner's parts from where its geometry tells they are, as smooth functions of a few numbers.

At 0 nothing moves. Offsets are in pixels along the told columns and rows, angles in degrees:

* ``u``, ``v``: the detector along its columns' and its rows' step;
* ``roll``: the detector in its own plane, about its middle, from ``u`` towards ``v``;
* ``tilt``: about its middle row, the far end of its columns away from the source;
* ``slant``: about its middle column, the far end of its rows away from the source;
* ``distance``: the detector away from the source, in per cent of the distance between them; nothing where rays are
  parallel;
* ``skew``: the axis of rotation along the beam, its upper end away from the source: scanner and detector turn about the
  pivot, an axis through the pivot being meant to be along ``v``;
* ``views``: the detector of every view by itself, along ``u`` and ``v``, (views, 2).

Offsets come first, then roll, tilt and slant, each about the axes as moved before, then the whole is skewed. These are
the misalignments of Noo et al. (2000, doi:10.1088/0031-9155/45/11/327) and Cho et al. (2005, doi:10.1118/1.1869652),
with shifts of single views besides.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import torch

from tomo_polysplat.checks import fail
from tomo_polysplat.scan.view_geometry import Geometry

__all__ = ["MOVES", "MovedViews", "Scanner", "moved_geometry"]

# The unit of every move.
MOVES = {
    "u": "px",
    "v": "px",
    "roll": "deg",
    "tilt": "deg",
    "slant": "deg",
    "distance": "%",
    "skew": "deg",
    "views": "px",
}


class MovedViews(NamedTuple):
    """Views as a `Geometry` has them, in tensors: each (views, 3) float64."""

    origin: torch.Tensor
    corner: torch.Tensor
    u: torch.Tensor
    v: torch.Tensor

    def joined(self, columns: float, rows: float) -> MovedViews:
        """The same detectors by pixels of so many columns and rows of these; less than 1 makes parts of pixels."""
        corner = self.corner + 0.5 * (columns - 1) * self.u + 0.5 * (rows - 1) * self.v
        return MovedViews(self.origin, corner, columns * self.u, rows * self.v)

    def vectors(self, cone: bool) -> torch.Tensor:
        """(views, 4, 3) source or corner, steps, and ray to the corner or direction, as the kernels take them."""
        if cone:
            return torch.stack([self.origin, self.u, self.v, self.corner - self.origin], dim=1)
        return torch.stack([self.corner, self.u, self.v, self.origin], dim=1)


class Scanner:
    """The told geometry, ready to be moved.

    Parameters
    ----------
    geometry : Geometry
    pivot : (3,) array
        A point on the axis of rotation, of which ``skew`` makes use: the middle of the object.
    """

    def __init__(self, geometry: Geometry, pivot: np.ndarray | None = None) -> None:
        self.geometry = geometry
        self.cone = geometry.beam == "cone"
        self.pivot = torch.zeros(3, dtype=torch.float64) if pivot is None else torch.tensor(pivot).double()
        parts = (geometry.origin, geometry.centre, geometry.u, geometry.v)
        self._told = tuple(torch.tensor(part, dtype=torch.float64) for part in parts)

    def moved(self, values: Mapping[str, torch.Tensor], chosen: np.ndarray | None = None) -> MovedViews:
        """The views of these indices, all of them by default, moved.

        Parameters
        ----------
        values : mapping of names of `MOVES` to float64 tensors
            0-dim, or (views, 2) for ``views``, of all views. What is not there does not move.
        chosen : (n,) int array, optional

        Raises
        ------
        ValueError
            For an unknown move.
        """
        _require_moves(values)
        index = slice(None) if chosen is None else torch.as_tensor(np.asarray(chosen))
        origin, centre, u, v = (part[index] for part in self._told)
        zero = torch.zeros((), dtype=torch.float64)
        shift = torch.stack([values.get("u", zero), values.get("v", zero)])
        shift = shift + values["views"][index] if "views" in values else shift.expand(len(u), 2)
        centre = centre + shift[:, :1] * u + shift[:, 1:] * v
        if self.cone and "distance" in values:
            centre = centre + 0.01 * values["distance"] * (centre - origin)
        # From u to v about their normal, which points away from the source or towards it.
        normal, along = _unit(torch.linalg.cross(u, v)), _unit(u)
        away = torch.sign((normal * (centre - origin if self.cone else origin)).sum(dim=1, keepdim=True))
        turns = {name: torch.deg2rad(values.get(name, zero)) for name in ("roll", "tilt", "slant", "skew")}
        u, v = (_turned(step, normal, turns["roll"]) for step in (u, v))
        v = _turned(v, _unit(u), away * turns["tilt"])
        u = _turned(u, _unit(v), -away * turns["slant"])
        if "skew" in values:
            turn = -away * turns["skew"]
            origin, centre = origin - self._base, centre - self.pivot
            origin, centre, u, v = (_turned(part, along, turn) for part in (origin, centre, u, v))
            origin, centre = origin + self._base, centre + self.pivot
        corner = centre - 0.5 * (self.geometry.columns - 1) * u - 0.5 * (self.geometry.rows - 1) * v
        return MovedViews(origin, corner, u, v)

    @property
    def _base(self) -> torch.Tensor:
        """What a source is counted from; a direction has no place."""
        return self.pivot if self.cone else torch.zeros(3, dtype=torch.float64)

    def project(self, values: Mapping[str, torch.Tensor], points: torch.Tensor) -> torch.Tensor:
        """(views, n, 2) column and row of points (n, 3), float64, by the moved geometry."""
        views = self.moved(values)
        third = views.corner - views.origin if self.cone else views.origin
        reference = views.origin if self.cone else views.corner
        matrix = torch.stack([views.u, views.v, third], dim=2)
        local = torch.linalg.solve(matrix[:, None], (points - reference[:, None])[..., None])[..., 0]
        return local[..., :2] / local[..., 2:] if self.cone else local[..., :2]


def moved_geometry(scanner: Scanner, values: Mapping[str, torch.Tensor]) -> Geometry:
    """The geometry with its parts moved."""
    with torch.no_grad():
        views = scanner.moved(values)
    told = scanner.geometry
    origin, corner, u, v = (part.numpy() for part in views)
    return Geometry(told.beam, origin, corner, u, v, told.rows, told.columns)


def _require_moves(values: Mapping[str, torch.Tensor]) -> None:
    for name in values:
        if name not in MOVES:
            raise fail("moves", f"names among {', '.join(MOVES)}", repr(name))


def _unit(vectors: torch.Tensor) -> torch.Tensor:
    return vectors / vectors.norm(dim=-1, keepdim=True)


def _turned(vectors: torch.Tensor, axis: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Vectors turned about unit axes by angles in radians, right-handed (Rodrigues' formula)."""
    along = (axis * vectors).sum(dim=-1, keepdim=True) * axis
    return torch.cos(angle) * (vectors - along) + torch.sin(angle) * torch.linalg.cross(axis, vectors) + along

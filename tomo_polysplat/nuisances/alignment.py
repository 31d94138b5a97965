"""The scanner's geometry as a nuisance: offsets and turns of the detector, the axis, and shifts of single views.

It acts on the views' vectors; nothing else of the forward model knows of it. A fit takes `Alignment.vectors` in the
place of the told ones, and hands the loss's gradient by them to `Alignment.gradient` and that to `Alignment.step`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from tomo_polysplat.checks import fail
from tomo_polysplat.nuisances.nuisance import Found, Nuisance, Parameter, Place, Verdict
from tomo_polysplat.scan.gauges import common_offset, effects, view_gauge, without_gauge
from tomo_polysplat.scan.moves import MOVES, MovedViews, Scanner, moved_geometry
from tomo_polysplat.scan.view_geometry import Geometry

__all__ = ["IN_PLANE", "USUAL", "Alignment"]

# What is moved where the rays tell it. Offsets along v and distances are left: the object takes their place. So is
# tilt: bone of 128^3 that was off by 2 pixels or rolled by 2 degrees, without any, was given 7 to 10 degrees of it.
USUAL = ("u", "roll", "skew", "views")
# In a scan of one plane, out of which nothing may move.
IN_PLANE = ("u", "views")
# Angles beyond these, and per cent, are no misalignments: a fit that goes there follows something else.
_LARGEST = {"roll": 10.0, "tilt": 10.0, "slant": 10.0, "skew": 10.0, "distance": 10.0}
# A move is fitted where the object leaves this share of what it does, and where a move by _COMMON of its unit shifts
# what is seen by so many pixels: else it does no harm, and is not told from noise.
_TOLD, _PIXELS, _COMMON = 0.1, 0.1, 3.0
# Units of a move made by a step of one pixel: less where a pixel would take more.
_MOST_A_PIXEL = 2.0
# Moves are kept where the misfit of held-out rays falls below this share of that without. 19 perfect scans of six
# scenes came to 0.970 and more for the whole scanner; an axis off by 0.25 pixels to 0.84 to 0.95, views shifted by as
# much to 0.94. By pixels that are not joined shifts of views explain thin metal, too: 0.95.
_MARGIN = 0.96
# Memories of the mean gradient and of its mean square; single views are seen once a pass only. Steps beyond _STEEPEST
# deviations of the gradient are cut.
_MEAN, _SQUARE, _VIEW_MEAN, _STEEPEST = 0.7, 0.95, 0.5, 3.0


class Alignment(Nuisance):
    """Moves of a scanner with their optimiser.

    Parameters
    ----------
    geometry : Geometry
        As told, in the coordinates of the fit.
    radius : float
        Of the object, likewise.
    names : sequence of names of `MOVES`, or "usual"
        What is moved; "usual" is what of `USUAL`, or of `IN_PLANE`, the rays tell.
    pivot : (3,) array, optional
        A point on the axis of rotation, the origin by default.
    start : mapping of name to number, optional
        Values to begin with, such as the offset that `check` has found.

    Attributes
    ----------
    names : tuple of str
    left : dict of str
        Why moves of `USUAL` are not fitted.

    Raises
    ------
    ValueError
        For an unknown move.
    """

    name = "alignment"
    place = Place.GEOMETRY
    parameters = {
        name: Parameter(unit, 0.0, -_LARGEST.get(name, math.inf), _LARGEST.get(name, math.inf))
        for name, unit in MOVES.items()
    }
    found_by = Found.GRADIENT
    gauge = "moves of the whole object: what views have in common, and what moves it, is taken out of their shifts"
    cost = (
        "a fit of one pass before the run, and more where it shows moves; if asked for, fits of joined pixels"
    )

    def __init__(
        self,
        geometry: Geometry,
        radius: float,
        *,
        names: str | Sequence[str] = "usual",
        pivot: np.ndarray | None = None,
        start: Mapping[str, float] | None = None,
    ) -> None:
        self.scanner = Scanner(geometry, pivot)
        usual = IN_PLANE if geometry.planar else USUAL
        wanted = usual if isinstance(names, str) and names == "usual" else tuple(names)
        for name in (*wanted, *(start or {})):
            if name not in MOVES:
                raise fail("align", f"'usual' or names among {', '.join(MOVES)}", repr(name))
        self.left: dict[str, str] = {}
        whole = [name for name in wanted if name != "views"]
        # Units that a step of one pixel makes.
        self._units: dict[str, float] = {}
        for name, effect in effects(self.scanner, whole, radius).items():
            self._units[name] = min(1 / max(effect.pixels, 1e-12), _MOST_A_PIXEL)
            if names == "usual" and effect.told < _TOLD:
                self.left[name] = f"the object can take its place but for {effect.told:.1%}"
            elif names == "usual" and effect.pixels * _COMMON < _PIXELS:
                self.left[name] = (
                    f"{_COMMON:g} {MOVES[name]} shift what is seen by {effect.pixels * _COMMON:.2f} px"
                )
        self.names = tuple(name for name in wanted if name not in self.left)
        self._gauge = view_gauge(self.scanner)
        shapes = {name: (geometry.views, 2) if name == "views" else () for name in self.names}
        self.values = {name: torch.zeros(shape, dtype=torch.float64) for name, shape in shapes.items()}
        for name, value in (start or {}).items():
            self.values[name] = torch.tensor(float(value), dtype=torch.float64)
        self.forget()

    @property
    def units(self) -> dict[str, str]:
        """Unit of every move."""
        return {name: MOVES[name] for name in self.values}

    def forget(self) -> None:
        """Begin anew with the optimiser's memory, at another level."""
        self._mean = {name: torch.zeros_like(self.values[name]) for name in self.names}
        self._square = dict.fromkeys(self.names, 0.0)
        self._steps = dict.fromkeys(self.names, 0)
        self._seen = {name: torch.zeros_like(self.values[name]) for name in self.names}

    def only(self, names: Sequence[str]) -> None:
        """Step these alone from now on; the values of others stay as they are."""
        self.names = tuple(name for name in self.names if name in names)
        self.forget()

    def moved(self, chosen: np.ndarray | None = None) -> MovedViews:
        """The views of these indices as they are moved."""
        return self.scanner.moved(self.values, chosen)

    def vectors(
        self, chosen: np.ndarray | None = None, columns: float = 1.0, rows: float = 1.0
    ) -> torch.Tensor:
        """(views, 4, 3) float64 vectors for the kernels, by pixels of so many columns and rows joined."""
        with torch.no_grad():
            return self.moved(chosen).joined(columns, rows).vectors(self.scanner.cone)

    def geometry(self) -> Geometry:
        """The geometry as it is moved."""
        return moved_geometry(self.scanner, self.values)

    def gradient(
        self, chosen: np.ndarray, of_vectors: torch.Tensor, columns: float = 1.0, rows: float = 1.0
    ) -> dict[str, torch.Tensor]:
        """The loss's gradient by every move, from that by `vectors` of the same arguments."""
        leaves = {name: self.values[name].clone().requires_grad_() for name in self.names}
        views = self.scanner.moved({**self.values, **leaves}, chosen).joined(columns, rows)
        slopes = torch.autograd.grad(
            views.vectors(self.scanner.cone), list(leaves.values()), of_vectors.double(), allow_unused=True
        )
        return {
            name: torch.zeros_like(self.values[name]) if slope is None else slope
            for name, slope in zip(leaves, slopes)
        }

    @torch.no_grad()
    def step(
        self, chosen: np.ndarray, gradient: Mapping[str, torch.Tensor], rate: float, hold: Sequence[str] = ()
    ) -> None:
        """Step against a `gradient`, by about ``rate`` pixels of what is seen; moves named in ``hold`` stay.

        As Adam does (Kingma and Ba 2015, arXiv:1412.6980), but that single views have one mean square in common.
        """
        for name in self.names:
            if name not in hold:
                slope = gradient[name] * self._units.get(name, 1.0)
                self._step_one(name, torch.as_tensor(np.asarray(chosen)), slope, rate)

    def _step_one(self, name: str, chosen: torch.Tensor, slope: torch.Tensor, rate: float) -> None:
        """Step of one move, whose gradient is by pixels of what is seen."""
        single = name == "views"
        where = chosen if single else ...
        slope = slope[where]
        self._steps[name] += 1
        self._square[name] += (1 - _SQUARE) * (float(slope.square().mean()) - self._square[name])
        deviation = (self._square[name] / (1 - _SQUARE ** self._steps[name])) ** 0.5
        if not deviation > 0.0:
            return
        keep = _VIEW_MEAN if single else _MEAN
        self._seen[name][where] += 1
        self._mean[name][where] = keep * self._mean[name][where] + (1 - keep) * slope
        along = self._mean[name][where] / (1 - keep ** self._seen[name][where]) / deviation
        bound = _LARGEST.get(name, float("inf"))
        moved = self.values[name][where] - rate * self._units.get(name, 1.0) * along.clamp(
            -_STEEPEST, _STEEPEST
        )
        self.values[name][where] = moved.clamp(-bound, bound)

    def hold_gauge(self, hold: Sequence[str] = ()) -> None:
        """Take out of the views' shifts what all have in common and what moves the object; between passes.

        What they have in common goes to the offsets that are fitted, whose steps are other than those of single views,
        but for those named in ``hold``.
        """
        if "views" not in self.values:
            return
        for name, offset in zip(("u", "v"), common_offset(self.values["views"], self.scanner)):
            if name in self.names and name not in hold:
                self.values[name] = self.values[name] + offset
        self.values["views"] = without_gauge(self.values["views"], self._gauge)

    @classmethod
    def gate(cls, evidence: Mapping[str, float]) -> Verdict:
        """By the misfits of held-out rays of fits alike: ``without`` the moves, and ``moved``."""
        kept = evidence["moved"] < _MARGIN * evidence["without"]
        share = evidence["moved"] / max(evidence["without"], 1e-300)
        return Verdict(
            kept, f"{share:.3f} of the misfit of held-out rays is left, {_MARGIN:g} at most is asked"
        )

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """The moves of a plan."""
        moved = {
            name: torch.tensor(values[name], dtype=torch.float64)
            for name in MOVES
            if np.any(values.get(name, 0))
        }
        return f"a geometry that has moved ({'; '.join(_in_words(_numbers(moved)))})" if moved else ""

    def report(self) -> dict[str, Any]:
        """Numbers for plan and report: moves of the whole scanner, and root mean squares of those of single views."""
        return _numbers(self.values)

    def describe(self) -> str:
        """A line for the log and the plan."""
        parts = _in_words(self.report())
        parts += [f"{name} not fitted: {why}" for name, why in self.left.items()]
        return "; ".join(parts) or "nothing is moved"

    def state(self) -> dict[str, np.ndarray]:
        """Values for a checkpoint; the optimiser's memory of a few steps is not kept."""
        return {name: value.numpy().copy() for name, value in self.values.items()}

    def restore(self, kept: Mapping[str, np.ndarray]) -> None:
        """Go on with the values of a `state`."""
        self.values = {name: torch.from_numpy(np.array(value, np.float64)) for name, value in kept.items()}
        self.forget()


def _numbers(values: Mapping[str, torch.Tensor]) -> dict[str, Any]:
    """See `Alignment.report`."""
    found: dict[str, Any] = {
        name: round(float(value), 4) for name, value in values.items() if name != "views"
    }
    if "views" in values:
        root = values["views"].square().mean(dim=0).sqrt()
        found["views"] = {"u": round(float(root[0]), 4), "v": round(float(root[1]), 4)}
    return found


def _in_words(report: Mapping[str, Any]) -> list[str]:
    """The moves of an `Alignment.report`."""
    return [
        f"views {value['u']:.3f} px rms along u and {value['v']:.3f} px along v"
        if name == "views"
        else f"{name} {value:+.3f} {MOVES[name]}"
        for name, value in report.items()
    ]

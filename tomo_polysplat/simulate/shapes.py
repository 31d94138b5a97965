"""Solid shapes of the analytic phantoms: ellipsoids, finite cylinders and boxes, anywhere and turned anyhow.

Every shape is an affine image of a unit solid. In its own frame, ``x = diag(1/semi) R^T (point - centre)``,
it is

.. math:: x_1^2 + \\dots + x_r^2 \\le 1, \\qquad |x_{r+1}| \\le 1, \\dots, |x_3| \\le 1,

with r, the number of round axes, 3 for an ellipsoid, 2 for a cylinder and 0 for a box. One formula therefore
serves all three, for the chord of a ray as for the test whether a point lies inside.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_number, require_shape

__all__ = ["Shape", "box", "cylinder", "ellipsoid", "rotation"]

Triple = Sequence[float] | np.ndarray


@dataclass(frozen=True)
class Shape:
    """A solid; made by :func:`ellipsoid`, :func:`cylinder` or :func:`box`.

    Attributes
    ----------
    round_axes : int
        Local axes that bound the solid together by a circle or a sphere; the others bound it by pairs of
        planes.
    centre : (3,) float64
        In cm.
    semi : (3,) float64
        Half extent along each local axis, in cm.
    axes : (3, 3) float64
        Rotation; its columns are the local axes in space.
    """

    round_axes: int
    centre: np.ndarray
    semi: np.ndarray
    axes: np.ndarray

    @cached_property
    def to_local(self) -> np.ndarray:
        """(3, 3) matrix that takes ``point - centre`` to the frame of the unit solid."""
        return self.axes.T / self.semi[:, None]

    @cached_property
    def radius(self) -> float:
        """Radius of the smallest sphere about the centre that holds the solid, in cm."""
        around = self.semi[: self.round_axes].max(initial=0.0)
        return float(np.hypot(around, np.linalg.norm(self.semi[self.round_axes :])))

    @cached_property
    def half_extent(self) -> np.ndarray:
        """(3,) half sizes of the tightest box along x, y, z, in cm."""
        columns = self.axes * self.semi
        around = np.linalg.norm(columns[:, : self.round_axes], axis=1)
        return around + np.abs(columns[:, self.round_axes :]).sum(axis=1)

    @property
    def volume(self) -> float:
        """In cm3."""
        unit = {3: 4.0 * np.pi / 3.0, 2: 2.0 * np.pi, 0: 8.0}[self.round_axes]
        return float(unit * np.prod(self.semi))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Which of the points (..., 3), in cm, lie inside or on the surface."""
        local = (np.asarray(points, float) - self.centre) @ self.to_local.T
        around = (local[..., : self.round_axes] ** 2).sum(axis=-1) <= 1.0
        return around & (np.abs(local[..., self.round_axes :]) <= 1.0).all(axis=-1)


def rotation(axis: Triple, degrees: float) -> np.ndarray:
    """Matrix (3, 3) that turns by an angle about an axis, right-handed (Rodrigues' formula)."""
    x, y, z = _unit("axis", axis)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    angle = np.deg2rad(require_number("degrees", degrees))
    return np.eye(3) + np.sin(angle) * cross + (1.0 - np.cos(angle)) * cross @ cross


def ellipsoid(centre: Triple, semi_axes: float | Triple, turn: np.ndarray | None = None) -> Shape:
    """Ellipsoid with three semi-axes in cm (one number: a ball), turned by a rotation matrix."""
    return _shape(3, centre, semi_axes, turn)


def box(centre: Triple, half_sizes: float | Triple, turn: np.ndarray | None = None) -> Shape:
    """Box with three half edges in cm (one number: a cube), turned by a rotation matrix."""
    return _shape(0, centre, half_sizes, turn)


def cylinder(
    centre: Triple, radius: float | Sequence[float], half_length: float, axis: Triple = (0, 0, 1)
) -> Shape:
    """Finite cylinder along any axis.

    Parameters
    ----------
    centre : (3,)
        Middle of its axis, in cm.
    radius : float or pair of float
        In cm; a pair makes the section an ellipse, with x first when the axis is z.
    half_length : float
        In cm.
    axis : (3,)
        Its direction, of any length.
    """
    radii = np.broadcast_to(np.asarray(radius, float), 2)
    return _shape(2, centre, (*radii, half_length), _frame_along(_unit("axis", axis)))


def _shape(round_axes: int, centre: Triple, semi: float | Triple, turn: np.ndarray | None) -> Shape:
    position = require_array("centre", centre, 1).astype(float)
    require_shape("centre", position, (3,), "(x, y, z) in cm")
    sizes = np.array(np.broadcast_to(require_array("semi-axes", semi).astype(float), 3))
    if not (np.isfinite(position).all() and np.isfinite(sizes).all() and (sizes > 0).all()):
        raise fail("shape", "a finite centre and sizes above 0 cm", f"centre {position}, sizes {sizes}")
    axes = np.eye(3) if turn is None else require_array("turn", turn, 2).astype(float)
    require_shape("turn", axes, (3, 3), "rotation matrix")
    # As `np.allclose` has it, which takes ten times as long for so small an array.
    if not (np.abs(axes @ axes.T - np.eye(3)) <= 1e-9 + 1e-5 * np.eye(3)).all():
        raise fail("turn", "a rotation matrix", f"{axes.tolist()}", "make it with rotation(axis, degrees)")
    return Shape(round_axes, position, sizes, axes)


def _unit(argument: str, vector: Triple) -> np.ndarray:
    values = require_array(argument, vector, 1).astype(float)
    require_shape(argument, values, (3,), "(x, y, z)")
    length = np.linalg.norm(values)
    if not (np.isfinite(length) and length > 0):
        raise fail(argument, "a direction", f"{values}")
    return values / length


def _frame_along(axis: np.ndarray) -> np.ndarray:
    """Rotation whose third column is the axis: the shortest turn from z, so that z itself gives identity."""
    cosine = axis[2]
    if cosine < -1.0 + 1e-12:
        return np.diag([1.0, -1.0, -1.0])
    cross = np.array([[0.0, 0.0, axis[0]], [0.0, 0.0, axis[1]], [-axis[0], -axis[1], 0.0]])
    return np.eye(3) + cross + cross @ cross / (1.0 + cosine)

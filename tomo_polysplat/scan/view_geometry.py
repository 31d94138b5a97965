"""Where the rays of every view run."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_choice, require_shape
from tomo_polysplat.scan.volume_grid import require_count

__all__ = ["Geometry"]

# |sin| of an angle below which two directions count as parallel: far above float64 rounding, far below any
# detector anyone would build.
_PARALLEL = 1e-9


@dataclass(frozen=True, eq=False)
class Geometry:
    """One flat detector position, and one source or beam direction, per view (all float64).

    Parameters
    ----------
    beam : {"cone", "parallel"}
        Rays from a point source, or all in one direction.
    origin : (views, 3)
        Cone: position of the source. Parallel: direction of the rays, of any length.
    corner : (views, 3)
        Position of the centre of the pixel in row 0 and column 0.
    u, v : (views, 3)
        Steps from a column to the next and from a row to the next.
    rows, columns : int
        Size of the detector in pixels.

    Raises
    ------
    ValueError
        If shapes disagree, a number is not finite, a step is zero, the steps are parallel to each other, or
        the detector is seen edge-on.
    """

    beam: str
    origin: np.ndarray
    corner: np.ndarray
    u: np.ndarray
    v: np.ndarray
    rows: int
    columns: int

    def __post_init__(self) -> None:
        require_choice("beam", self.beam, ("cone", "parallel"))
        for name in ("rows", "columns"):
            object.__setattr__(self, name, require_count(f"detector {name}", getattr(self, name)))
        views = len(require_array("origin", self.origin, ndim=2))
        if views == 0:
            raise fail("projection geometry", "at least one view", "none")
        for name in ("origin", "corner", "u", "v"):
            # A private, read-only copy: a geometry is a value, whatever the caller does to its arrays.
            array: np.ndarray = np.array(require_array(name, getattr(self, name)), dtype=np.float64)
            require_shape(name, array, (views, 3), "(views, xyz)")
            _refuse_views(np.any(~np.isfinite(array), axis=1), name, "finite vectors", "NaN or infinity")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        self._check_vectors()

    def _check_vectors(self) -> None:
        towards = self.corner - self.origin if self.beam == "cone" else self.origin
        lengths = {"u": self.u, "v": self.v, "source to detector" if self.beam == "cone" else "ray": towards}
        for name, vectors in lengths.items():
            _refuse_views(~(np.linalg.norm(vectors, axis=1) > 0), name, "a vector of length > 0", "zero")
        normal = np.cross(_unit(self.u), _unit(self.v))
        sine = np.linalg.norm(normal, axis=1)
        _refuse_views(sine < _PARALLEL, "u and v", "two different directions", "parallel vectors")
        edge_on = np.abs(np.einsum("vk,vk->v", normal / sine[:, None], _unit(towards))) < _PARALLEL
        _refuse_views(edge_on, "detector", "rays that cross its plane", "rays in its plane")

    @property
    def views(self) -> int:
        """Number of views."""
        return len(self.origin)

    @property
    def shape(self) -> tuple[int, int, int]:
        """``(views, rows, columns)``: the shape of the projections."""
        return self.views, self.rows, self.columns

    @property
    def planar(self) -> bool:
        """True if every ray of the scan lies in one plane z = constant: a 2D scan."""
        if self.rows != 1:
            return False
        scale = np.abs(self.corner).max() + np.linalg.norm(self.u, axis=1).max() * self.columns
        heights = [self.corner[:, 2] - self.corner[0, 2], self.u[:, 2] * self.columns]
        if self.beam == "cone":
            heights.append(self.origin[:, 2] - self.corner[0, 2])
        else:
            heights.append(_unit(self.origin)[:, 2] * scale)
        return bool(max(np.abs(h).max() for h in heights) <= 1e-9 * scale)

    @property
    def centre(self) -> np.ndarray:
        """Position of the middle of the detector, (views, 3)."""
        return self.corner + 0.5 * (self.columns - 1) * self.u + 0.5 * (self.rows - 1) * self.v

    def select(self, views: np.ndarray | slice) -> Geometry:
        """The geometry of some of the views: indices, a slice or a boolean mask."""
        return replace(self, **{k: getattr(self, k)[views] for k in ("origin", "corner", "u", "v")})

    def shifted(self, by: np.ndarray) -> Geometry:
        """The whole scanner moved by the vector ``by``, (3,)."""
        by = np.asarray(by, dtype=np.float64)
        origin = self.origin + by if self.beam == "cone" else self.origin
        return replace(self, origin=origin, corner=self.corner + by)

    def scaled(self, factor: float) -> Geometry:
        """The same scanner in another unit of length: every coordinate times ``factor``."""
        origin = self.origin * factor if self.beam == "cone" else self.origin
        return replace(self, origin=origin, corner=self.corner * factor, u=self.u * factor, v=self.v * factor)

    def normalised(self, centre: np.ndarray, length: float) -> Geometry:
        """The same scanner in the coordinates ``(x - centre) / length``."""
        return self.shifted(-np.asarray(centre, dtype=np.float64)).scaled(1.0 / length)

    def cropped(self, rows: tuple[int, int], columns: tuple[int, int]) -> Geometry:
        """The detector's rows and columns from the first of each pair up to, and without, the second."""
        for name, (first, last), most in (("rows", rows, self.rows), ("columns", columns, self.columns)):
            if not 0 <= first < last <= most:
                raise fail(name, f"first < last, from 0 to {most}", f"{first}, {last}")
        corner = self.corner + columns[0] * self.u + rows[0] * self.v
        return replace(self, corner=corner, rows=rows[1] - rows[0], columns=columns[1] - columns[0])

    def binned(self, factor: int, row_factor: int | None = None) -> Geometry:
        """The detector with ``factor`` columns and as many rows, or ``row_factor``, joined to one.

        The columns and rows left over at the far ends are dropped. A detector of one row keeps its row.
        """
        factor = require_count("binning factor", factor)
        row_factor = factor if row_factor is None else require_count("binning factor of rows", row_factor)
        row_factor = 1 if self.rows == 1 else row_factor
        if factor > self.columns or row_factor > self.rows:
            most = f"at most {self.columns} columns and {self.rows} rows"
            raise fail("binning factor", most, f"{factor} and {row_factor}")
        # The centre of the joined pixel is the mean of the centres of its parts.
        corner = self.corner + 0.5 * (factor - 1) * self.u + 0.5 * (row_factor - 1) * self.v
        rows, columns = self.rows // row_factor, self.columns // factor
        return replace(
            self, corner=corner, u=self.u * factor, v=self.v * row_factor, rows=rows, columns=columns
        )

    def projection_matrices(self) -> tuple[np.ndarray, np.ndarray]:
        """Matrices that take points to the detector.

        Returns
        -------
        inverse : (views, 3, 3)
            With ``(alpha, beta, gamma) = inverse @ (p - reference)``: in a cone beam ``p`` falls on column
            ``alpha / gamma`` and row ``beta / gamma`` with magnification ``1 / gamma`` (``gamma <= 0`` means
            at or behind the source); in a parallel beam on column ``alpha`` and row ``beta``.
        reference : (views, 3)
            The source (cone) or the centre of pixel (0, 0) (parallel).
        """
        third = self.corner - self.origin if self.beam == "cone" else self.origin
        reference = self.origin if self.beam == "cone" else self.corner
        return np.linalg.inv(np.stack([self.u, self.v, third], axis=2)), reference

    def project_points(self, points: np.ndarray) -> np.ndarray:
        """Detector coordinates of points, for every view.

        Parameters
        ----------
        points : (n, 3)
            Positions ``(x, y, z)``.

        Returns
        -------
        (views, n, 2) float64
            ``(column, row)``; whole numbers are pixel centres. NaN for a point at or behind the source.
        """
        points = np.asarray(require_array("points", points, ndim=2), dtype=np.float64)
        require_shape("points", points, (len(points), 3), "(n, xyz)")
        inverse, reference = self.projection_matrices()
        local = np.einsum("vkl,vnl->vnk", inverse, points[None] - reference[:, None])
        if self.beam == "parallel":
            return local[..., :2]
        depth = np.where(local[..., 2:] > 0, local[..., 2:], np.nan)
        return local[..., :2] / depth

    def rays(self, view: int) -> tuple[np.ndarray, np.ndarray]:
        """The rays to all pixel centres of one view.

        Returns
        -------
        origins, directions : (rows, columns, 3) float64
            A point on each ray (the source in a cone beam, the pixel in a parallel one) and its unit
            direction.
        """
        column = np.arange(self.columns)[None, :, None]
        row = np.arange(self.rows)[:, None, None]
        pixels = self.corner[view] + column * self.u[view] + row * self.v[view]
        if self.beam == "parallel":
            return pixels, np.broadcast_to(_unit(self.origin[view]), pixels.shape)
        return np.broadcast_to(self.origin[view], pixels.shape), _unit(pixels - self.origin[view])

    def magnification(self, point: np.ndarray) -> np.ndarray:
        """How many times larger than life an object at ``point`` (3,) appears on the detector, (views,)."""
        if self.beam == "parallel":
            return np.ones(self.views)
        inverse, reference = self.projection_matrices()
        return 1.0 / np.einsum("vl,vl->v", inverse[:, 2], np.asarray(point, dtype=np.float64) - reference)

    def pixel_size_at(self, point: np.ndarray) -> tuple[float, float]:
        """Median over the views of the pixel's width and height, brought down to ``point`` (3,)."""
        magnification = self.magnification(point)
        width = np.median(np.linalg.norm(self.u, axis=1) / magnification)
        height = np.median(np.linalg.norm(self.v, axis=1) / magnification)
        return float(width), float(height)

    def describe(self) -> str:
        """One line for a log."""
        kind = "2D " if self.planar else ""
        width, height = (np.median(np.linalg.norm(step, axis=1)) for step in (self.u, self.v))
        size = f"{self.views} views of {self.rows} x {self.columns} pixels"
        text = f"{kind}{self.beam} beam, {size}, each {width:.4g} x {height:.4g} (width x height)"
        if self.beam == "parallel":
            return text
        distance = np.linalg.norm(self.centre - self.origin, axis=1)
        least, most = f"{distance.min():.4g}", f"{distance.max():.4g}"
        return f"{text}, source to detector {least if least == most else f'{least} to {most}'}"


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def _refuse_views(bad: np.ndarray, argument: str, expected: str, got: str) -> None:
    if bad.any():
        first = int(np.argmax(bad))
        raise fail(
            argument, expected, f"{got} in {int(bad.sum())} of {len(bad)} views, first in view {first}"
        )

"""What a scanner's folder tells, whatever scanner it was."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.scan.circular import cone_geometry, parallel_geometry
from tomo_polysplat.scan.geometry import Geometry, geometry_from_astra

if TYPE_CHECKING:
    from tomo_polysplat.scan.readers.frames import Frames

__all__ = ["Acquisition", "Guess", "Setup", "Tube"]


@dataclass(frozen=True)
class Setup:
    """A circular scan about z, for pictures as one sees them who looks from the source, z up.

    Attributes
    ----------
    degrees : array, shape (views,)
        Angles of the source, counterclockwise seen from +z.
    pixel : float, or (width, height)
        On the detector.
    source_object, source_detector : float or None
        None for a parallel beam.
    offset : (u, v)
        Of the detector's middle from the foot of the ray through the axis, to the right and up.
    roll : float
        Degrees by which the detector is turned about its middle, counterclockwise.
    axis : float
        How far to the right of the line from the source to the foot the axis stands, source and detector facing each
        other. A turntable that was moved aside is that; a detector that was, `offset`.
    tilt : float
        Degrees by which the axis leans from the source towards the detector, as its upper end goes.
    """

    degrees: np.ndarray
    pixel: float | tuple[float, float]
    source_object: float | None = None
    source_detector: float | None = None
    offset: tuple[float, float] = (0.0, 0.0)
    roll: float = 0.0
    axis: float = 0.0
    tilt: float = 0.0

    def geometry(self, rows: int, columns: int) -> Geometry:
        """Of a detector whose rows ascend with z."""
        known: dict[str, Any] = {"pixel": self.pixel, "degrees": self.degrees, "offset": self.offset}
        known |= {"detector": (rows, columns)}
        if self.source_object is None or self.source_detector is None:
            proj_geom, _ = parallel_geometry(**known)
        else:
            known |= {"source_object": self.source_object, "source_detector": self.source_detector}
            proj_geom, _ = cone_geometry(**known)
        upright = _tilted(geometry_from_astra(proj_geom), -self.tilt)
        return _rolled(_moved(upright, -self.axis), self.roll)


def _tilted(geometry: Geometry, degrees: float) -> Geometry:
    """Source and detector turned together about the line through the middle along the columns.

    Positive where what is above leans from the source to the detector.
    """
    if not degrees:
        return geometry
    right = geometry.u / np.linalg.norm(geometry.u, axis=1, keepdims=True)
    sine, cosine = np.sin(np.deg2rad(degrees)), np.cos(np.deg2rad(degrees))

    def turned(vectors: np.ndarray) -> np.ndarray:
        # Rodrigues' formula; what leans from z towards the detector turns about minus `right`.
        along = (vectors * right).sum(axis=1, keepdims=True) * right
        return along + cosine * (vectors - along) - sine * np.cross(right, vectors)

    u, v, corner, origin = (
        turned(part) for part in (geometry.u, geometry.v, geometry.corner, geometry.origin)
    )
    return replace(geometry, origin=origin, corner=corner, u=u, v=v)


def _moved(geometry: Geometry, right: float) -> Geometry:
    """Source and detector moved along the columns together."""
    if not right:
        return geometry
    step = right * geometry.u / np.linalg.norm(geometry.u, axis=1, keepdims=True)
    origin = geometry.origin + step if geometry.beam == "cone" else geometry.origin
    return replace(geometry, origin=origin, corner=geometry.corner + step)


def _rolled(geometry: Geometry, degrees: float) -> Geometry:
    if not degrees:
        return geometry
    width, height = (np.linalg.norm(step, axis=1, keepdims=True) for step in (geometry.u, geometry.v))
    right, up, angle = geometry.u / width, geometry.v / height, np.deg2rad(degrees)
    u = width * (np.cos(angle) * right + np.sin(angle) * up)
    v = height * (np.cos(angle) * up - np.sin(angle) * right)
    corner = geometry.centre - 0.5 * (geometry.columns - 1) * u - 0.5 * (geometry.rows - 1) * v
    return replace(geometry, corner=corner, u=u, v=v)


@dataclass(frozen=True)
class Tube:
    """The tube as the folder tells of it; None where it does not.

    Attributes
    ----------
    kvp : float or None
        In kV.
    filters : mapping or None
        Material and thickness in cm; empty if there is said to be none.
    anode : str
    detector : str or None
        Its name, as `tomo_polysplat.Detector.named` takes it.
    """

    kvp: float | None = None
    filters: Mapping[str, float] | None = None
    anode: str = "W"
    detector: str | None = None


class Guess(str):
    """What had to be guessed, in words, until somebody states one of some keys.

    Attributes
    ----------
    unless : tuple of str
        Names of `tomo_polysplat.scan.readers.stated.KEYS`.
    """

    unless: tuple[str, ...] = ()

    def __new__(cls, words: str, *unless: str) -> Guess:
        guess = super().__new__(cls, words)
        guess.unless = unless
        return guess


@dataclass(frozen=True, eq=False)
class Acquisition:
    """Pictures that are read when they are asked for, and what is known about them.

    Attributes
    ----------
    kind : str
        Of scanner or file, in words.
    frames : Frames
        The projections.
    setup : Setup or Geometry
        Where the rays run. A `Geometry` has rows that ascend with z and columns as seen from the source.
    name : str
    unit : str
        Of the lengths.
    input : str
        ``"counts"``, ``"transmission"`` or ``"attenuation"``.
    flats, darks : Frames or None
        Pictures without the object, and without light.
    light : array, shape (views,), or None
        Of the beam in each view, over that in the flats, as a monitor counted it.
    white : float or None
        Counts of the open beam, the same in each pixel, where there are no flats.
    saturates : bool
        Whether the largest value that the integers can have means a saturated pixel.
    top_first : bool
        Whether the first row is the top one.
    from_detector : bool
        Whether pictures are as seen from the detector, left and right exchanged.
    tube : Tube
    exposure : float or None
        Seconds a picture.
    shifts : array, shape (views, 2), or None
        Columns and rows, as the pictures are stored, by which each has to be moved to fit the setup.
    said : tuple of str
        What had to be guessed.
    other : mapping of texts
        What else there was to read, as it stands.
    """

    kind: str
    frames: Frames
    setup: Setup | Geometry
    name: str = "scan"
    unit: str = "mm"
    input: str = "counts"
    flats: Frames | None = None
    darks: Frames | None = None
    light: np.ndarray | None = None
    white: float | None = None
    saturates: bool = True
    top_first: bool = True
    from_detector: bool = False
    tube: Tube = Tube()
    exposure: float | None = None
    shifts: np.ndarray | None = None
    said: tuple[str, ...] = ()
    other: Mapping[str, str] = field(default_factory=dict)

    def geometry(self) -> Geometry:
        """Where the rays of the pictures run, rows ascending with z and columns as seen from the source."""
        _, rows, columns = self.frames.shape
        plain = self.setup if isinstance(self.setup, Geometry) else self.setup.geometry(rows, columns)
        if self.shifts is None:
            return plain
        right = -self.shifts[:, :1] if self.from_detector else self.shifts[:, :1]
        up = -self.shifts[:, 1:] if self.top_first else self.shifts[:, 1:]
        return replace(plain, corner=plain.corner + right * plain.u + up * plain.v)

    def saying(self, *guesses: str) -> Acquisition:
        """The same with more guesses told."""
        return replace(self, said=(*self.said, *guesses))

"""A small scan with a marker off the axis, and its counts as a panel reads them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.circular import cone_geometry, parallel_geometry
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.phantom import Part, Phantom
from tomo_polysplat.simulate.scanner import Scanner
from tomo_polysplat.simulate.scenes import scan_phantom
from tomo_polysplat.simulate.shapes import cylinder, ellipsoid

__all__ = ["MARKER", "SETTINGS", "Pictures", "corrected", "marked_scan", "pictures_of"]

# Where the marker is, in cm: on no axis, and higher than the middle.
MARKER = (0.45, 0.2, 0.3)


@dataclass(frozen=True)
class _Settings:
    """Of the scanner, in mm, degrees, kV."""

    source_object: float = 100.0
    source_detector: float = 250.0
    pixel: float = 1.6
    kvp: float = 90.0
    filter_mm: float = 1.0
    columns_off: float = 1.5


SETTINGS = _Settings()


@dataclass(frozen=True)
class Pictures:
    """Counts of a scanner, rows from the top down, columns as seen from the source.

    Attributes
    ----------
    projections : (views, rows, columns) uint16
    flats, darks : (frames, rows, columns) uint16
    degrees : (views,)
        Angles of the source, counterclockwise seen from above.
    """

    projections: np.ndarray
    flats: np.ndarray
    darks: np.ndarray
    degrees: np.ndarray


# One parameter for each option that a caller names.
def marked_scan(
    views: int = 48,
    rows: int = 33,
    columns: int = 37,
    *,
    beam: str = "cone",
    columns_off: float = SETTINGS.columns_off,
    aside: float = 0.0,
    seed: int = 0,
) -> Scan:
    """A PMMA cylinder of 14 mm, a hole and an aluminium ball at `MARKER` in it, in mm.

    Parameters
    ----------
    views, rows, columns : int
    beam : {"cone", "parallel"}
    columns_off : float
        Columns by which the detector's middle is to the right of the axis' shadow.
    aside : float
        By how much source and detector are to the right of the axis, in mm.
    seed : int
        Of the noise.
    """
    import astra

    at, degrees = SETTINGS, np.arange(views) * (360.0 / views)
    across = 1.0 if beam == "cone" else at.source_object / at.source_detector
    known = {
        "pixel": 0.1 * at.pixel * across,
        "detector": (rows, columns),
        "degrees": degrees,
        "offset": (0.1 * at.pixel * across * columns_off, 0.0),
    }
    if beam == "cone":
        distances = {
            "source_object": 0.1 * at.source_object,
            "source_detector": 0.1 * at.source_detector,
        }
        proj_geom, vol_geom = cone_geometry(**known, **distances)  # type: ignore[arg-type]
    else:
        proj_geom, vol_geom = parallel_geometry(**known)  # type: ignore[arg-type]
    if aside:
        proj_geom = astra.geom_2vec(proj_geom)
        vectors = proj_geom["Vectors"]
        right = vectors[:, 6:9] / np.linalg.norm(vectors[:, 6:9], axis=1, keepdims=True)
        vectors[:, :3] += 0.1 * aside * right
        vectors[:, 3:6] += 0.1 * aside * right
    phantom = Phantom(
        [
            Part(cylinder((0.0, 0.0, 0.0), 0.7, 0.6), "pmma", 1.19),
            Part(ellipsoid((-0.3, 0.25, -0.1), 0.15), "pmma", 0.0),
            Part(ellipsoid(MARKER, 0.15), "aluminium", 2.7),
        ]
    )
    spectrum = Spectrum.from_tube(at.kvp, filters={"Al": 0.1 * at.filter_mm}, detector="csi:0.6mm")
    return scan_phantom(phantom, proj_geom, vol_geom, spectrum, Scanner(1e5, seed=seed), name="marker")


def corrected(pictures: Pictures, white: float) -> np.ndarray:
    """The projections with their flat field and dark pictures taken out, the open beam being `white`."""
    light = (pictures.flats - pictures.darks.astype(np.float64)).mean(axis=0)
    passed = (pictures.projections - pictures.darks[0].astype(np.float64)) / light
    return np.clip(np.rint(white * passed), 0, 65535).astype(np.uint16)


def pictures_of(scan: Scan, *, light: float = 40000.0, dark: float = 100.0, frames: int = 3) -> Pictures:
    """What a panel with uneven gain reads in `scan`, whose noise is in it already."""
    rows, columns = scan.rows, scan.columns
    slope = np.linspace(0.8, 1.2, columns)[None, :] * np.linspace(1.1, 0.9, rows)[:, None]
    passed = np.exp(-scan.projections.transpose(1, 0, 2)[:, ::-1].astype(np.float64))
    lit = slope * light
    degrees = np.arange(scan.views) * (360.0 / scan.views)
    counts = (
        np.clip(np.rint(values), 0, 65535).astype(np.uint16) for values in (dark + lit * passed, dark + lit)
    )
    projections, flat = counts
    darks = np.full((frames, rows, columns), round(dark), np.uint16)
    return Pictures(projections, np.broadcast_to(flat, (frames, rows, columns)).copy(), darks, degrees)

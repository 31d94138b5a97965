"""From what a scanner's folder tells to a scan."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, visible
from tomo_polysplat.evenly_spread import evenly_spread
from tomo_polysplat.scan.circular import volume_seen
from tomo_polysplat.scan.counts import Counts
from tomo_polysplat.scan.defects import flat_and_dark
from tomo_polysplat.scan.geometry import Geometry, geometry_to_astra
from tomo_polysplat.scan.half_acquisition import with_room
from tomo_polysplat.scan.in_blocks import line_integrals
from tomo_polysplat.scan.layout import spatial_geometry
from tomo_polysplat.scan.readers.acquisition import Acquisition, Setup
from tomo_polysplat.scan.readers.part import Part
from tomo_polysplat.scan.readers.upright import Upright
from tomo_polysplat.scan.reading import ReadOptions
from tomo_polysplat.scan.scan import Scan

if TYPE_CHECKING:
    from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["scan_from_acquisition"]

logger = logging.getLogger(__name__)

# Percent of the pixels of pictures without flats that are darker than what is taken for the open beam.
_BRIGHT = 99.0
# Degrees under which a source sees a detector: few scanners have 60, and none so many.
_WIDE_VIEW, _NO_VIEW = 90.0, 130.0
# Rays to look at, and line integrals that the middle one of them cannot have: of more light than was sent, by 1.65, and
# of less than 1e-13 of it.
_LOOKED_AT, _BRIGHTER, _OPAQUE = 100_000, 0.5, 30.0
# Share of rays without any light from which decimals of no open beam are taken for no counts.
_WITHOUT = 0.05
# A usual flat panel, where nothing tells of the detector.
_PANEL = "csi:0.6mm"


def scan_from_acquisition(told: Acquisition, options: ReadOptions, part: Part) -> Scan:
    """Read the pictures and make a scan of them.

    Parameters
    ----------
    told : Acquisition
    options : ReadOptions
        What the caller of `tomo_polysplat.load_scan` says, which comes first.
    part : Part
        What to read.

    Returns
    -------
    Scan
        Its ``notes["scanner"]`` has, as texts, what the folder told and what had to be guessed.
    """
    kind = options.input or told.input
    limit = _limit(told, kind, options.saturation)
    pictures = Upright(told, part, limit)
    geometry = _geometry(told)
    told = _in_view(told)
    told, flat, dark = _open_beam(told, kind, pictures)
    counts = Counts(lambda: nullcontext(pictures.views), pictures.shape, kind, flat, dark, limit)
    projections, valid, rays = line_integrals(counts, options.progress)
    if told.light is not None and kind == "counts" and told.flats is not None:
        projections += np.log(told.light[pictures.chosen]).astype(np.float32)[:, None]
    if told.flats is None and told.white is None and flat is not None:
        _require_light(told, float(flat.max()), rays["no_light"] / valid.size)
    _require_possible(told, kind, projections, valid)
    told, spectrum = _spectrum(told, options)
    seen = part.of(geometry, (pictures.rows, pictures.columns))
    _tell(told, rays, valid)
    scan = Scan(
        projections=projections,
        valid=None if valid.all() else valid,
        spectrum=spectrum,
        water_correction=None if options.water_correction is None else tuple(options.water_correction),
        name=told.name,
        notes={"input": kind, "rays": rays, "scanner": _texts(told)},
        **_geometries(seen, told, options),
    )
    return with_room(scan) if options.vol_geom is None and options.proj_geom is None else scan


def _limit(told: Acquisition, kind: str, saturation: float | None) -> float:
    if kind != "counts" or not (told.saturates or saturation):
        return np.inf
    if saturation is not None:
        return saturation
    return float(np.iinfo(told.frames.dtype).max) if told.frames.dtype.kind in "iu" else np.inf


def _geometry(told: Acquisition) -> Geometry:
    views, rows, columns = told.frames.shape
    geometry = told.geometry()
    if geometry.shape != (views, rows, columns):
        got = f"{geometry.views} angles for {views} pictures of {rows} x {columns} pixels"
        if geometry.views == views:
            got = f"{geometry.rows} x {geometry.columns} for pictures of {rows} x {columns} pixels"
        raise fail("path", "one angle for each picture, and a detector of their size", got)
    if views < 2:
        raise fail("projections", "pictures of at least two views", "one", "name the others (--projections)")
    return geometry


def _in_view(told: Acquisition) -> Acquisition:
    """Refuse a detector that goes far around the source, as one does whose pixels are in another unit."""
    setup = told.setup
    if not isinstance(setup, Setup) or not setup.source_detector:
        return told
    sides = np.broadcast_to(np.asarray(setup.pixel, np.float64), 2) * told.frames.shape[:0:-1]
    angle = 2 * float(np.rad2deg(np.arctan(0.5 * sides.max() / setup.source_detector)))
    got = f"{angle:.0f} degrees for {sides.max():g} {told.unit} in a distance of {setup.source_detector:g} {told.unit}"
    if angle > _NO_VIEW:
        remedy = "give all lengths in one unit: the pixel, source_object and source_detector"
        raise fail("pixel", f"a detector within {_NO_VIEW:g} degrees, seen from the source", got, remedy)
    if angle > _WIDE_VIEW:
        return told.saying(
            f"the source sees the detector under {got}: are the pixel and the distances in one unit?"
        )
    return told


def _open_beam(
    told: Acquisition, kind: str, pictures: Upright
) -> tuple[Acquisition, np.ndarray | None, np.ndarray | None]:
    """The pictures without an object and without light, where counts have to be compared with them."""
    if kind != "counts":
        return told, None, None
    size, names = pictures.shape[1:], ("flats", "darks")
    told = _deep_enough(told)
    dark = None if told.darks is None else pictures.mean(told.darks, "darks")
    if told.flats is not None:
        flat = pictures.mean(told.flats, "flats")
        _require_reachable("flats", float(np.nanmean(flat)), told)
        return told, *flat_and_dark(flat, dark, size, names)
    white = told.white
    if white is None:
        white = pictures.bright(_BRIGHT)
        told = told.saying(
            f"no flat field: the open beam is taken to be {white:.6g} counts, as in the brightest pixels; give flats= "
            "or white= if that is wrong"
        )
    _require_reachable("white", white, told)
    return told, *flat_and_dark(np.full(size, white), dark, size, ("white", "darks"))


def _deep_enough(told: Acquisition) -> Acquisition:
    """Say of pictures of 8 bits what they cannot show."""
    if told.frames.dtype.itemsize > 1:
        return told
    return told.saying(
        "the pictures have 8 bits, 256 grey values: what is faint or dense is lost; export 16 bits if the scanner can"
    )


def _require_reachable(name: str, light: float, told: Acquisition) -> None:
    """Refuse an open beam of more counts than the pictures' numbers go to: one of the two was converted."""
    dtype = told.frames.dtype
    # A white level may be the first number that is not reached.
    if dtype.kind not in "iu" or light <= np.iinfo(dtype).max + 1:
        return
    expected = f"counts that pictures of {dtype} can have, {np.iinfo(dtype).max} at most"
    remedy = "were the pictures converted to fewer bits? take those that the scanner wrote, or say white="
    raise fail(name, expected, f"{light:.6g}", remedy)


def _require_light(told: Acquisition, open_beam: float, without: float) -> None:
    """Refuse what cannot be counts without flats: where there is air, line integrals are as often below 0 as above."""
    if told.frames.dtype.kind != "f" or open_beam > _OPAQUE or without < _WITHOUT or 0.7 < open_beam < 1.3:
        return
    got = f"decimals up to {open_beam:.3g}, {100 * without:.0f} % of them 0 or less, as line integrals have them"
    raise fail("input", "counts, or their open beam beside them", got, "say attenuation (--input), or white=")


def _require_possible(told: Acquisition, kind: str, projections: np.ndarray, valid: np.ndarray) -> None:
    """Refuse rays most of which are brighter than the open beam, or darker than anything that lets light through."""
    chosen = np.unravel_index(evenly_spread(valid.size, _LOOKED_AT), valid.shape)
    some = projections[chosen][valid[chosen]]
    middle = float(np.median(some)) if some.size else 0.0
    if kind == "attenuation" and middle > _OPAQUE:
        remedy = "counts are input='counts'; integrals that were multiplied are divided first"
        raise fail(
            "input", "line integrals, such as 0 to 10", f"{middle:.6g} in half of the rays and more", remedy
        )
    if middle < -_BRIGHTER:
        name = "input" if kind != "counts" else "white" if told.flats is None else "flats"
        got = f"{np.exp(-min(middle, 0.0)):.3g} times its light in half of the rays and more"
        remedy = "take flats and darks of the same scan and exposure; counts are input='counts'"
        raise fail(name, "an open beam that the object makes darker", got, remedy)


def _geometries(seen: Geometry, told: Acquisition, options: ReadOptions) -> dict[str, Any]:
    """``proj_geom``, ``vol_geom`` and ``unit``: the caller's, else as the folder tells."""
    unit = options.settled_unit(told.unit, told.unit)
    if options.proj_geom is not None:
        proj_geom = spatial_geometry(dict(options.proj_geom))
    else:
        proj_geom = geometry_to_astra(seen)
    vol_geom = volume_seen(seen) if options.vol_geom is None else dict(options.vol_geom)
    return {"proj_geom": proj_geom, "vol_geom": vol_geom, "unit": unit}


def _spectrum(told: Acquisition, options: ReadOptions) -> tuple[Acquisition, Spectrum | None]:
    """The caller's spectrum, else that of the tube and its filters behind a usual detector."""
    tube = told.tube
    if options.spectrum is not None:
        return told, options.spectrum
    if told.unit == "pixel":
        lacking = "lengths are in pixels, with which a spectrum cannot be used; give pixel="
        return told if tube.kvp is None else told.saying(lacking), None
    if tube.kvp is None:
        # A parallel beam is mostly a synchrotron's, of one energy.
        if _geometry(told).beam == "cone":
            told = told.saying(
                "the voltage of the tube is not known, and without a spectrum metal is not corrected; give kvp=, "
                "filter= and detector="
            )
        return told, None
    if tube.filters is None:
        return told.saying(
            f"the tube was at {tube.kvp:g} kV, its filter is not known: there is no spectrum; give filter="
        ), None
    from tomo_polysplat.physics.detector import Detector
    from tomo_polysplat.physics.spectrum import Spectrum

    detector = Detector.named(tube.detector or _PANEL)
    try:
        spectrum = Spectrum.from_tube(tube.kvp, tube.anode, dict(tube.filters), detector)
    except ValueError as error:
        return told.saying(f"there is no spectrum: {error}"), None
    known = (
        f"the spectrum is that of a tube of {tube.anode} at {tube.kvp:g} kV behind {_filter_words(tube.filters)}; "
        "filters that are built in are not told"
    )
    if tube.detector is None:
        known += ", nor is the detector: a flat panel of 0.6 mm CsI is taken; give detector= for another"
    return told.saying(known), spectrum


def _filter_words(filters: Mapping[str, float]) -> str:
    return " + ".join(f"{10 * size:g} mm {name}" for name, size in filters.items()) or "no filter"


def _tell(told: Acquisition, rays: dict[str, int], valid: np.ndarray) -> None:
    """All guesses in one warning, a line each."""
    if len(told.said) == 1:
        logger.warning("%s: %s", told.kind, told.said[0])
    elif told.said:
        lines = "\n  - ".join(["what is not told is guessed:", *map(visible, told.said)])
        logger.warning("%s: %s", visible(told.kind), lines, extra={"has_own_lines": True})
    lost = valid.size - np.count_nonzero(valid)
    if lost:
        kinds = ", ".join(f"{count} {name.replace('_', ' ')}" for name, count in rays.items() if count)
        logger.warning("%d of %d rays are left out (%s)", lost, valid.size, kinds)


def _texts(told: Acquisition) -> dict[str, Any]:
    """What was told, as texts that may be shown."""
    known = {
        "kind": told.kind,
        "tube_kv": told.tube.kvp,
        "filter": None if told.tube.filters is None else _filter_words(told.tube.filters),
        "exposure_s": told.exposure,
    }
    texts: dict[str, Any] = {name: visible(value) for name, value in known.items() if value is not None}
    texts["guessed"] = [visible(guess) for guess in told.said]
    texts["keys"] = {visible(key): visible(value) for key, value in told.other.items()}
    return texts

"""TomoPy: ``tomopy.recon(tomo, theta, center=c, algorithm=tomo_polysplat.polysplat, options={...})``.

A parallel beam, unless the options give an ASTRA geometry. Slices come back as from TomoPy's own algorithms:
image row 0 at the largest y, attenuation in 1/pixel, or in 1/unit once the size of a pixel is known.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from itertools import groupby
from typing import Any

import numpy as np

import tomo_polysplat
from tomo_polysplat.checks import fail, require_choice, require_number, require_shape
from tomo_polysplat.plugins.host_options import spectrum_of, split_options
from tomo_polysplat.plugins.tomopy_chunks import ChunkCollector

__all__ = ["polysplat"]

logger = logging.getLogger(__name__)

_chunks = ChunkCollector()

OWN_OPTIONS = ("pixel_size", "proj_geom", "vol_geom", "input", "energy_kev", "on_result")


def polysplat(
    tomo: np.ndarray, center: np.ndarray, recon: np.ndarray, theta: np.ndarray, **keywords: Any
) -> None:
    """The ``algorithm`` for ``tomopy.recon``: one solve, however TomoPy cuts the slices into chunks.

    Parameters
    ----------
    tomo : float32 array, shape (slices, views, columns)
        Sinograms, -log(I/I0). Not modified. NaN, and zeros in the middle of the object, are left out,
        and infinite rays opaque where dark ones surround them; ``Result.counts`` has both.
    center : float32 array, shape (slices,)
        Rotation axis in columns from the detector's edge; neighbours that share it are solved together.
    recon : float32 array, shape (slices, num_gridx, num_gridy)
        Receives the slices. What `init_recon` puts there is not used as a start.
    theta : float32 array, shape (views,)
        Angles in radians; what looks like degrees is refused.
    **keywords
        ``num_gridx``, ``num_gridy`` and ``options``, a dict that is not modified:

        - ``spectrum``, or ``kvp`` with ``filters`` (cm), ``anode`` and ``detector``; ``materials``;
        - ``pixel_size`` in ``unit`` (default cm), which a spectrum needs; then values are in 1/unit;
        - ``proj_geom`` and ``vol_geom``, ASTRA's in `unit`, with one slice per detector row;
        - ``quality``, ``time_budget`` (seconds), ``seed``, ``device``, ``settings``, ``calibrate``, ``soft_density``,
          ``align``, ``water_correction``, ``callbacks``, ``progress``, ``checkpoint`` and ``resume`` as for
          :func:`tomo_polysplat.reconstruct`;
        - ``input="transmission"`` when no logarithm was taken; ``energy_kev`` of the slices;
        - ``on_result``: called with the :class:`~tomo_polysplat.Result` of each group of slices.

    Raises
    ------
    ValueError, TypeError
        For an unknown keyword or option, or one that contradicts another. TomoPy raises it in the caller.

    """
    options = keywords.pop("options", None)
    if isinstance(options, np.ndarray) and options.ndim == 0:  # what TomoPy makes of a dict
        options = options.item()
    grid = tuple(int(keywords.pop(f"num_grid{axis}", size)) for axis, size in zip("xy", recon.shape[-2:]))
    require_shape("init_recon", recon, (*recon.shape[:-2], *grid), "(..., num_gridx, num_gridy)")
    for name, value in keywords.items():
        raise fail(name, "no such keyword", repr(value), "see options of tomo_polysplat.polysplat")
    own, solver, tube = split_options({} if options is None else options, OWN_OPTIONS)
    _require_one_geometry(own, solver, polychromatic=bool(tube) or solver.get("spectrum") is not None)
    whole = _chunks.add(tomo, center, recon)
    if whole is None:
        return
    tomo, center, recon = whole
    solver |= spectrum_of(tube)
    _require_kinds(own, solver)
    if own.get("proj_geom") is not None:
        if not np.allclose(center, tomo.shape[2] / 2):
            raise fail("center", "None beside proj_geom", f"{center[0]:g}", "proj_geom places the axis")
        _solve(tomo, recon, own["proj_geom"], own["vol_geom"], own, solver)
        return
    if solver.get("checkpoint") is not None and len(np.unique(center)) > 1:
        remedy = "slices with different centres are solved apart, and one file keeps one solve"
        raise fail("options['checkpoint']", "one centre for all slices", "several", remedy)
    start = 0
    for centre, group in groupby(center.tolist()):
        part = slice(start, start := start + len(list(group)))
        geometry = _parallel_beam(tomo[part], recon[part], theta, centre, own.get("pixel_size"))
        shared = dict(solver)
        if shared.get("time_budget") is not None:
            shared["time_budget"] *= (part.stop - part.start) / len(tomo)
        _solve(tomo[part], recon[part], *geometry, own, shared)


def _require_kinds(own: dict[str, Any], solver: dict[str, Any]) -> None:
    """Refuse before the work what would only fail after it, or by arithmetic."""
    from tomo_polysplat.physics.spectrum import require_energy_of

    if own.get("energy_kev") is not None:
        require_energy_of("options['energy_kev']", own["energy_kev"], solver.get("spectrum"))
    if own.get("on_result") is not None and not callable(own["on_result"]):
        raise fail("options['on_result']", "a function of a Result", repr(own["on_result"]), error=TypeError)
    if solver.get("time_budget") is not None:
        solver["time_budget"] = require_number("options['time_budget']", solver["time_budget"], above=0)
    if own.get("pixel_size") is not None:
        require_number("options['pixel_size']", own["pixel_size"], above=0)


def _require_one_geometry(own: dict[str, Any], solver: dict[str, Any], *, polychromatic: bool) -> None:
    """Refuse a geometry that is stated in part or twice, and fill in the unit that goes with it."""
    stated = own.get("proj_geom") is not None
    if stated != (own.get("vol_geom") is not None):
        raise fail("options", "both of proj_geom and vol_geom", "one of them")
    if stated and own.get("pixel_size") is not None:
        raise fail("options['pixel_size']", "none beside proj_geom", "both", "the geometry has its size")
    if stated or own.get("pixel_size") is not None:
        solver.setdefault("unit", "cm")
    elif solver.setdefault("unit", "pixel") != "pixel":
        raise fail("options['pixel_size']", f"the size of a pixel in {solver['unit']}", "none")
    elif polychromatic:
        remedy = "a spectrum needs real lengths: pass it, and options['unit'] where that is not cm"
        raise fail("options['pixel_size']", "the size of a pixel beside a spectrum", "none", remedy)


def _parallel_beam(
    tomo: np.ndarray, recon: np.ndarray, theta: np.ndarray, centre: float, pixel_size: float | None
) -> tuple[dict[str, Any], dict[str, Any]]:
    from tomo_polysplat.scan.angles import require_radians
    from tomo_polysplat.scan.circular import parallel_geometry
    from tomo_polysplat.scan.layout import volume_geometry

    # A geometry of vectors, which this becomes, has no angles to tell by.
    theta = require_radians("theta", theta)
    size = 1.0 if pixel_size is None else pixel_size
    columns = tomo.shape[2]
    proj_geom, _ = parallel_geometry(
        pixel=size, radians=theta, detector=(len(tomo), columns), offset=((columns / 2 - centre) * size, 0.0)
    )
    window = np.repeat(0.5 * size * np.array(recon.shape[::-1]), 2) * np.tile([-1, 1], 3)
    return proj_geom, volume_geometry(np.array(recon.shape), window)


def _solve(
    tomo: np.ndarray,
    recon: np.ndarray,
    proj_geom: Mapping[str, Any],
    vol_geom: Mapping[str, Any],
    own: dict[str, Any],
    solver: dict[str, Any],
) -> None:
    """Reconstruct slices that share a geometry, into `recon`."""
    from tomo_polysplat.scan.geometry import from_astra
    from tomo_polysplat.scan.layout import spatial_geometry

    spatial_geometry(dict(proj_geom))
    remedy = "TomoPy makes one slice per detector row, of num_gridx x num_gridy pixels"
    shape = from_astra(proj_geom, vol_geom)[1].shape
    require_shape("recon", recon, shape, "of vol_geom (slices, rows, columns)", remedy)
    projections, valid = _line_integrals(tomo, own.get("input", "attenuation"))
    result = tomo_polysplat.reconstruct(projections, proj_geom, vol_geom, valid=valid, **solver)
    energy = own.get("energy_kev")
    recon[...] = (result.volume if energy is None else result.attenuation(energy))[:, ::-1]
    if own.get("on_result") is not None:
        own["on_result"](result)


def _line_integrals(tomo: np.ndarray, kind: str) -> tuple[np.ndarray, np.ndarray | None]:
    """Projections (rows, views, columns), TomoPy's order of sinograms, and which of them to use."""
    from tomo_polysplat.scan.defects import attenuation
    from tomo_polysplat.scan.dropouts import dropped_rays

    require_choice("options['input']", kind, ("attenuation", "transmission"))
    projections, valid, _ = attenuation(tomo, kind)
    valid &= ~dropped_rays(np.where(valid, projections, np.nan))
    # No light is something that a ray says; a zero in a transmission as well, unless it fills in for a bad ray.
    valid |= np.isposinf(projections)
    lost = int(valid.size - np.count_nonzero(valid))
    if lost:
        logger.warning(
            "%d of %d rays of tomo are left out: not finite, or zero in the object", lost, valid.size
        )
    return projections, valid if lost else None

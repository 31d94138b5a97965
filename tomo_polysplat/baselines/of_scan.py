"""The usual methods on a scan: what is not usable is left out or bridged as the method does it."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

from tomo_polysplat.baselines.arrays import fdk as fdk_of_arrays
from tomo_polysplat.baselines.arrays import limar as limar_of_arrays
from tomo_polysplat.baselines.arrays import nmar as nmar_of_arrays
from tomo_polysplat.baselines.arrays import sirt as sirt_of_arrays
from tomo_polysplat.baselines.arrays import water_bhc as water_bhc_of_arrays
from tomo_polysplat.checks import fail
from tomo_polysplat.physics.filter_map import FilterMap
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.result.provenance import provenance
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.scan.usable import usable_rays

__all__ = ["fdk", "limar", "nmar", "sirt", "water_bhc"]


def fdk(scan: Scan, *, filter_name: str = "ram-lak", device: str = "auto") -> Result:
    """Filtered backprojection, of one energy and nothing corrected (Feldkamp et al. 1984, doi:10.1364/JOSAA.1.000612).

    Parameters
    ----------
    scan : Scan
        A circular scan; the message of the error says what does not fit.
    filter_name : {"ram-lak", "shepp-logan", "cosine", "hamming", "hann"}
        From sharp to smooth.
    device : {"auto", "cpu", "cuda", "cuda:N"}

    Returns
    -------
    Result
        Monochromatic: attenuation in 1/unit of the scan at whatever energy its rays stand for.

    Raises
    ------
    ValueError
        If filtered backprojection does not fit the scan.
    """
    return _result(scan, "FDK", fdk_of_arrays.fdk, device, None, filter_name=filter_name)


def sirt(scan: Scan, *, iterations: int = 50, subsets: int = 1, device: str = "auto") -> Result:
    """Least squares without negative values (Gregor and Benson 2008, doi:10.1109/TMI.2008.923696); for any geometry.

    Parameters
    ----------
    scan : Scan
    iterations : int
        Times that every view is used.
    subsets : int
        Groups of views that are each followed by an update.
    device : {"auto", "cpu", "cuda", "cuda:N"}

    Returns
    -------
    Result
        As of `fdk`.
    """
    return _result(scan, "SIRT", sirt_of_arrays.sirt, device, None, iterations=iterations, subsets=subsets)


def water_bhc(scan: Scan, *, device: str = "auto") -> Result:
    """`fdk` after the usual correction of beam hardening by water (Herman 1979, doi:10.1088/0031-9155/24/1/008).

    Parameters
    ----------
    scan : Scan
        With its spectrum.
    device : {"auto", "cpu", "cuda", "cuda:N"}

    Returns
    -------
    Result
        Attenuation at the effective energy, right where the object is water; that of `fdk` under one energy.

    Raises
    ------
    ValueError
        For a scan without spectrum or unit of length, or one that filtered backprojection does not fit.
    """
    if scan.spectrum is None:
        raise fail("scan", "a scan with its spectrum", "none", "pass spectrum= to load_scan")
    if scan.spectrum.is_monochromatic:
        return _result(scan, "FDK", fdk_of_arrays.fdk, device, None)
    if scan.unit == "pixel":
        raise fail(
            "scan", "a scan with a unit of length", "pixels", "how much water hardens depends on lengths"
        )
    return _result(scan, "FDK after water correction", water_bhc_of_arrays.water_bhc, device, scan.spectrum)


def limar(scan: Scan, *, metal_level: float | None = None, device: str = "auto") -> Result:
    """Interpolates the rays through metal (Kalender et al. 1987, doi:10.1148/radiology.164.2.3602406), then `fdk`.

    Parameters
    ----------
    scan : Scan
        Its spectrum, where it has one, corrects for water first.
    metal_level : float, optional
        What is metal, in multiples of the main matter.
    device : {"auto", "cpu", "cuda", "cuda:N"}

    Returns
    -------
    Result
        As of `water_bhc`; metal as a first reconstruction shows it.

    Raises
    ------
    ValueError
        If filtered backprojection does not fit the scan.
    """
    return _result(scan, "LIMAR", limar_of_arrays.limar, device, scan.spectrum, metal_level=metal_level)


def nmar(scan: Scan, *, metal_level: float | None = None, device: str = "auto") -> Result:
    """`limar` after dividing by the projections of a segmented prior (Meyer et al. 2010, doi:10.1118/1.3484090).

    Parameters, result and errors are those of `limar`.
    """
    return _result(scan, "NMAR", nmar_of_arrays.nmar, device, scan.spectrum, metal_level=metal_level)


def _result(
    scan: Scan,
    name: str,
    method: Callable[..., np.ndarray],
    device: str,
    spectrum: Spectrum | None,
    **options: Any,
) -> Result:
    """What a method of arrays makes of a scan, and how long it took."""
    begun = time.perf_counter()
    if not isinstance(scan, Scan):
        raise fail("scan", "a Scan", type(scan).__name__, "use load_scan or tps.Scan(...)", TypeError)
    if device == "auto":
        device = "cuda" if torch.cuda.is_available() else "cpu"
    if spectrum is not None and (spectrum.is_monochromatic or scan.unit == "pixel"):
        spectrum = None
    correction = None if spectrum is None else scan.water_correction
    values, counts, _ = usable_rays(scan.projections, scan.proj_geom, scan.usable, correction, spectrum)
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    if spectrum is not None and scan.filter_map is not None:
        behind = FilterMap.of(scan.filter_map, scan.unit, *values.shape[1:])
        values = behind.as_if_bare(torch.from_numpy(values), spectrum, "water").numpy()
    energies = {} if spectrum is None else {"spectrum": spectrum}
    volume = method(values, geometry, grid, device=device, **energies, **options)
    only = scan.spectrum if scan.spectrum is not None and scan.spectrum.is_monochromatic else spectrum
    made = provenance(geometry, grid, scan.unit, scan.spectrum, torch.device(device))
    return Result(
        volume[None],
        grid,
        scan.unit,
        None if only is None else only.effective_energy,
        settings={name: value for name, value in options.items() if value is not None},
        counts=counts,
        provenance={"scan": scan.name, "method": name} | made,
        seconds=time.perf_counter() - begun,
    )

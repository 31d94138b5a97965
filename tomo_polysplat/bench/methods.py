"""The methods that a benchmark can compare, by name, behind one signature."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from tomo_polysplat.baselines.arrays.fdk import fdk
from tomo_polysplat.baselines.arrays.limar import limar
from tomo_polysplat.baselines.arrays.mono_splat import mono_splat
from tomo_polysplat.baselines.arrays.nmar import nmar
from tomo_polysplat.baselines.arrays.sirt import sirt
from tomo_polysplat.baselines.arrays.voxel_poly import voxel_poly
from tomo_polysplat.baselines.arrays.water_bhc import water_bhc, water_corrected
from tomo_polysplat.bench import peers
from tomo_polysplat.bench.task import Options, Outcome, Task
from tomo_polysplat.fit.fork import FEWEST_PASSES
from tomo_polysplat.reconstruction import reconstruct
from tomo_polysplat.result.result import Result

__all__ = ["METHODS", "WHOLE", "Method"]


# In runs of fewer passes it is not asked whether pixels average light; see `plan.decisions.pixel_rays`.
WHOLE = {"passes": FEWEST_PASSES}


@dataclass(frozen=True)
class Method:
    """One way to reconstruct.

    Attributes
    ----------
    label : str
        Its name in figures.
    run : callable
        From a Task and Options to the volume and what there is to say about the run.
    improves : bool
        Whether it takes a time budget and callbacks.
    whole : dict
        Settings with which the few views of a warm-up are enough for all that a run does, so that on a GPU nothing is
        left to compile when it is timed.
    """

    label: str
    run: Callable[[Task, Options], Outcome]
    improves: bool = False
    whole: Mapping[str, Any] = field(default_factory=dict)


def _direct(function: Callable[..., np.ndarray], *, spectrum: bool = False, **fixed: Any) -> Any:
    """A method that runs to its end: ``function(projections, geometry, grid[, spectrum], device=...)``."""

    def run(task: Task, _: Options) -> Outcome:
        energies = (task.spectrum,) if spectrum else ()
        data = (task.projections, task.geometry, task.grid, *energies)
        return function(*data, device=task.device, **fixed), dict(fixed)

    return run


def _fit_options(task: Task, options: Options) -> dict[str, Any]:
    return {
        "unit": task.scan.unit,
        "seed": task.seed,
        "device": task.device,
        "settings": options.settings,
        "time_budget": options.time_budget,
        "callbacks": options.callbacks,
    }


def _voxel_poly(task: Task, options: Options) -> Outcome:
    data = (task.projections, task.geometry, task.grid, task.spectrum)
    return voxel_poly(*data, **_fit_options(task, options)), {}


def _mono(task: Task, options: Options) -> Outcome:
    data = (task.projections, task.geometry, task.grid)
    return _told(mono_splat(*data, progress=False, **_fit_options(task, options)))


def _mono_water(task: Task, options: Options) -> Outcome:
    corrected = water_corrected(task.projections, task.spectrum)
    return _mono(replace(task, projections=corrected), options)


def _polysplat(task: Task, options: Options) -> Outcome:
    scan = task.scan
    return _told(
        reconstruct(
            scan.projections,
            scan.proj_geom,
            scan.vol_geom,
            spectrum=scan.spectrum,
            valid=scan.valid,
            progress=False,
            **_fit_options(task, options),
        )
    )


def _told(result: Result) -> Outcome:
    about: dict[str, Any] = {
        key: result.plan[key].to_dict() for key in ("kernel", "stop", "curves") if key in result.plan
    }
    return result.volume, {"gaussians": result.counts.get("gaussians"), **about}


METHODS = {
    "fdk": Method("FDK", _direct(fdk)),
    "fdk-water": Method("FDK after water correction", _direct(water_bhc, spectrum=True)),
    "sirt": Method("SIRT, 50 iterations", _direct(sirt, iterations=50)),
    "sirt-200": Method("SIRT, 200 iterations", _direct(sirt, iterations=200)),
    "limar": Method("LIMAR after water correction", _direct(limar, spectrum=True)),
    "nmar": Method("NMAR after water correction", _direct(nmar, spectrum=True)),
    "mbir": Method("mbirtorch", peers.mbirtorch_recon),
    "mbir-mar": Method("mbirtorch, low weights in metal", peers.mbirtorch_mar),
    "mbir-metal": Method("mbirtorch, plastic and metal", peers.mbirtorch_plastic_metal),
    "voxel-poly": Method("polychromatic voxels", _voxel_poly, improves=True),
    "mono": Method("Gaussians, one energy", _mono, improves=True),
    "mono-water": Method("Gaussians, one energy, after water correction", _mono_water, improves=True),
    "polysplat": Method("tomo-polysplat", _polysplat, improves=True, whole=WHOLE),
}

"""What an ablation changes: every variant is a reconstruction with other arguments, through the public call."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from tomo_polysplat.bench.methods import WHOLE, Method
from tomo_polysplat.bench.task import Options, Outcome, Task
from tomo_polysplat.physics.materials import MaterialLike
from tomo_polysplat.reconstruction import reconstruct

__all__ = ["DEFAULT", "GROUPS", "Variant"]

# Half its mass iron: with it in the middle, (1-u)^2, 2u(1-u), u^2 add up to (1-u) water + u iron.
_HALF_IRON = {"water": 0.5, "iron": 0.5}
_LINE: tuple[MaterialLike, ...] = ("water", _HALF_IRON, "iron")
# Where bone lies on that line: least squares of its curve at 90 kV, both taken relative to 55 keV.
_BONE_ON_LINE = 0.16
# Farther than any volume is wide, in voxels.
_EVERYWHERE = 1e5


@dataclass(frozen=True)
class Variant:
    """One way to run the solver.

    Attributes
    ----------
    label : str
        What is different.
    settings : mapping
        Changes of the solver's settings.
    samples : int
        Equally spaced energies that stand for the spectrum, each a node; 0 for the whole spectrum.
    materials : three materials, or None
    one_energy : bool
        No spectrum at all.
    """

    label: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    samples: int = 0
    materials: tuple[MaterialLike, ...] | None = None
    one_energy: bool = False

    def method(self) -> Method:
        """It as a method of a benchmark."""
        return Method(self.label, self._run, improves=True, whole=WHOLE)

    def _run(self, task: Task, options: Options) -> Outcome:
        scan, settings = task.scan, {**options.settings, **self.settings}
        spectrum = task.spectrum
        if self.samples:
            spectrum, settings = spectrum.sampled(self.samples), settings | {"spectral_nodes": self.samples}
        result = reconstruct(
            scan.projections,
            scan.proj_geom,
            scan.vol_geom,
            spectrum=None if self.one_energy else spectrum,
            materials=self.materials,
            unit=scan.unit,
            seed=task.seed,
            device=task.device,
            valid=scan.valid,
            time_budget=options.time_budget,
            callbacks=options.callbacks,
            progress=False,
            settings=settings,
        )
        # Samples of a spectrum have a mean of their own; the truth is at that of the whole.
        energy = scan.truth_energy_kev
        volume = result.volume if self.one_energy or energy is None else result.attenuation(energy)
        told = ("spectrum", "gaussians", "views_per_step", "stop")
        return volume, {"plan": {key: result.plan[key].to_dict() for key in told if key in result.plan}}


DEFAULT = Variant("default")

_line = {"bone_u": _BONE_ON_LINE}

# The default is measured once and stands in every group's table.
GROUPS: dict[str, tuple[Variant, ...]] = {
    "components": (
        Variant("one energy, no TV", {"tv_weight": 0.0}, one_energy=True),
        Variant("one energy", one_energy=True),
        Variant("no TV", {"tv_weight": 0.0}),
        Variant("every difference in full", {"tv_corner": 1000.0}),
    ),
    "nodes": (
        *(Variant(f"{n} uniform samples", samples=n) for n in (7, 15, 31, 63)),
        *(Variant(f"{n} fitted nodes", {"spectral_nodes": n}) for n in (3, 5)),
    ),
    "curve": (
        Variant("straight line water to iron", _line, materials=_LINE),
        Variant("free mixture of water and iron", _line | {"free_radius": _EVERYWHERE}, materials=_LINE),
    ),
    "free": (
        Variant("u free in pieces of metal only", {"free_radius": 0.0}),
        Variant("u free within 3 voxels of dense matter", {"free_radius": 3.0}),
        Variant("u free everywhere", {"free_radius": _EVERYWHERE}),
    ),
    "weights": (
        Variant("photon weights, absolute residuals", {"loss": "weighted-l1"}),
        # With hardly any error of the model the weights are those of photon noise, exp(-P/2), alone.
        Variant("weights exp(-P/2)", {"loss": "weighted-l1", "model_error": 3e-4}),
        Variant("plain L1", {"loss": "l1"}),
        Variant("the paper's: plain L1 + 0.25 (1 - SSIM)", {"loss": "l1", "ssim_weight": 0.25}),
    ),
    "blur": (
        Variant("rays infinitely thin", {"blur": 0.0, "learning_rate_blur": 0.0}),
        Variant("blur held at its start", {"learning_rate_blur": 0.0}),
    ),
    "relocation": (Variant("no relocation", {"relocated": 0.0}),),
}

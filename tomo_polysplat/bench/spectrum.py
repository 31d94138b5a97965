"""What wrong physics costs: tube, filters, detector, scatter, water correction, with and without calibration."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tomo_polysplat.bench.environment import environment
from tomo_polysplat.bench.scenes import cached_scan, object_of, require_scene
from tomo_polysplat.checks import require_choice
from tomo_polysplat.files import replacing
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.detector import Detector
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.water import water_linearised
from tomo_polysplat.plan.short_fit import main_density
from tomo_polysplat.reconstruction import reconstruct
from tomo_polysplat.report.style import ACCENT, QUIET
from tomo_polysplat.result.metrics import compare
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.settings import PRESETS
from tomo_polysplat.start.levels import mass_level
from tomo_polysplat.units import cm_per

__all__ = ["CASES", "SpectrumBench", "as_markdown", "run_spectrum_bench", "write_figure"]

Record = dict[str, Any]

_KVP, _FILTER = 90.0, 0.1
# Degree of the polynomial that a scanner is given as its water correction, as scanners have it.
_DEGREE = 3


@dataclass(frozen=True)
class Case:
    """What is assumed, as factors of what is true, and what was done to the rays.

    Attributes
    ----------
    kvp, filtration : float
    detector : Detector or None
        What is assumed instead of photon counting.
    scatter : float
        Nobody told of it.
    water_correction : {"none", "told", "not told"}
        Whether the scanner has corrected its rays for water, and has said so.
    """

    kvp: float = 1.0
    filtration: float = 1.0
    detector: Detector | None = None
    scatter: float = 0.0
    water_correction: str = "none"

    def spectrum(self) -> Spectrum:
        """The spectrum that the reconstruction is given."""
        filters = {"Al": self.filtration * _FILTER}
        return Spectrum.from_tube(self.kvp * _KVP, filters=filters, detector=self.detector or "counting")


CASES = {
    "right": Case(),
    "kVp -10 %": Case(kvp=0.9),
    "kVp +10 %": Case(kvp=1.1),
    "filter -20 %": Case(filtration=0.8),
    "filter +20 %": Case(filtration=1.2),
    "CsI panel assumed": Case(detector=Detector.energy_integrating()),
    "scatter 2 %": Case(scatter=0.02),
    "scatter 5 %": Case(scatter=0.05),
    "scatter 10 %": Case(scatter=0.1),
    "water-corrected, told": Case(water_correction="told"),
    "water-corrected, not told": Case(water_correction="not told"),
}


@dataclass(frozen=True)
class SpectrumBench:
    """What to measure.

    Attributes
    ----------
    scenes : sequence of str
        Names for `bench.scenes.require_scene`. In pins, PMMA is named as the soft material.
    cases : sequence of str
        Names of ``CASES``.
    size, views : int
    quality : str
    device : str
    seed : int
    """

    scenes: Sequence[str] = ("pins", "teeth", "lung-control")
    cases: Sequence[str] = tuple(CASES)
    size: int = 48
    views: int = 120
    quality: str = "fast"
    device: str = "cpu"
    seed: int = 0

    def __post_init__(self) -> None:
        for name in self.scenes:
            require_scene(name)
        for name in self.cases:
            require_choice("cases", name, CASES)
        require_choice("quality", self.quality, PRESETS)


def run_spectrum_bench(
    bench: SpectrumBench,
    *,
    cache: Path | None = None,
    progress: Callable[[str], Any] = lambda _: None,
    update: Callable[[Record], Any] = lambda _: None,
) -> Record:
    """Reconstruct every scene under every assumption, without and with calibration.

    Parameters
    ----------
    bench : SpectrumBench
    cache : path, optional
        Folder of simulated scans.
    progress, update : callable
        Told in words what comes next; given the record after every case.

    Returns
    -------
    dict
        JSON-able: ``bench``, ``environment``, and ``runs`` with ``scene``, ``case``, ``calibrated``, the errors of
        :func:`~tomo_polysplat.result.metrics.compare` at the energy of the truth, ``soft_bias`` (relative error of
        the mean outside metal), ``own_psnr`` (of the volume at the energy of the spectrum in use),
        ``held_out``, ``seconds`` and what the calibration found.
    """
    record: Record = {"bench": asdict(bench), "environment": environment(), "runs": []}
    for scene in bench.scenes:
        for name in bench.cases:
            scan = _scan(bench, scene, CASES[name], cache)
            for calibrated in (False, True):
                progress(f"{scene}, {name}, {'with' if calibrated else 'without'} calibration")
                run = _run(bench, scene, scan, CASES[name], calibrated)
                record["runs"].append({"scene": scene, "case": name, "calibrated": calibrated, **run})
            update(record)
    return record


def _scan(bench: SpectrumBench, scene: str, case: Case, cache: Path | None) -> Scan:
    physics = {"kvp": _KVP, "filters": {"Al": _FILTER}, "scatter": case.scatter}
    options = {"photons": 1e5, "seed": bench.seed}
    scan = cached_scan(scene, bench.size, bench.views, folder=cache, **physics, **options)
    return scan if case.water_correction == "none" else _water_corrected(scan)


def _water_corrected(scan: Scan) -> Scan:
    """What a scanner hands out that puts every ray through a polynomial, as if the object were water."""
    assert scan.spectrum is not None
    largest = float(scan.projections.max())
    values = np.linspace(0.0, largest, 257)[1:]
    powers = values[:, None] ** np.arange(1, _DEGREE + 1)
    fitted = np.linalg.lstsq(powers, water_linearised(values, scan.spectrum), rcond=None)[0]
    polynomial = np.polynomial.Polynomial([0.0, *fitted])
    corrected = polynomial(scan.projections.astype(np.float64)).astype(np.float32)
    return replace(scan, projections=corrected, water_correction=tuple(map(float, polynomial.coef)))


def _run(bench: SpectrumBench, scene: str, scan: Scan, case: Case, calibrated: bool) -> Record:
    assert scan.truth is not None and scan.truth_energy_kev is not None
    materials = Materials("pmma") if object_of(scene) == "pins" else Materials()
    per_gram = float(mass_attenuation(materials.soft, scan.truth_energy_kev)) * cm_per(scan.unit)
    density = _known_density(scan, per_gram) if calibrated else None
    result = reconstruct(
        scan.projections,
        scan.proj_geom,
        scan.vol_geom,
        spectrum=case.spectrum(),
        materials=materials,
        unit=scan.unit,
        valid=scan.valid,
        water_correction=scan.water_correction if case.water_correction == "told" else None,
        quality=bench.quality,
        seed=bench.seed,
        device=bench.device,
        progress=False,
        calibrate=calibrated,
        soft_density=density,
    )
    volume = result.attenuation(scan.truth_energy_kev)
    rest = np.ones(volume.shape, bool) if scan.metal_mask is None else ~scan.metal_mask
    found = result.plan["calibration"].value if "calibration" in result.plan else None
    return {
        **compare(volume, scan.truth, scan.metal_mask),
        "soft_bias": float(volume[rest].sum() / scan.truth[rest].sum() - 1.0),
        "own_psnr": compare(result.volume, scan.truth, scan.metal_mask)["psnr"],
        "held_out": result.history[-1]["held_out"] if result.history else None,
        "seconds": result.seconds,
        "fitted": None if found is None else found["fitted"],
        "why": None if found is None else found["why"],
    }


def _known_density(scan: Scan, per_gram: float) -> float:
    """What somebody who knows the object would say that most of it has: the metal does not count."""
    assert scan.truth is not None
    metal = np.zeros(scan.truth.shape, bool) if scan.metal_mask is None else scan.metal_mask
    density = np.where(metal, 0.0, scan.truth / per_gram)
    return main_density(density) or mass_level(density)


def as_markdown(record: Mapping[str, Any]) -> str:
    """A table for each scene."""
    lines: list[str] = []
    for scene in record["bench"]["scenes"]:
        lines += [f"**{scene}**", ""]
        lines += ["| assumed | PSNR without metal | PSNR everywhere | soft bias | calibrated to |"]
        lines += ["|---|---|---|---|---|"]
        for case in record["bench"]["cases"]:
            pair = [r for r in record["runs"] if (r["scene"], r["case"]) == (scene, case)]
            if len(pair) == 2:
                lines.append(_row(case, *pair))
        lines.append("")
    return "\n".join(lines)


def _row(case: str, without: Mapping[str, Any], calibrated: Mapping[str, Any]) -> str:
    cells = [f"{without[key]:.1f} -> {calibrated[key]:.1f}" for key in ("psnr", "psnr_all")] + [
        f"{100 * without['soft_bias']:+.1f} -> {100 * calibrated['soft_bias']:+.1f} %"
    ]
    fitted = calibrated["fitted"]
    words = {"scatter": "scatter {:.3f}", "kvp": "kVp x {:.3f}", "filter": "filter x {:.2f}"}
    told = ", ".join(words[name].format(value) for name, value in fitted.items()) or "as it was"
    return f"| {case} | {cells[0]} | {cells[1]} | {cells[2]} | {told} |"


def write_figure(path: Path, record: Mapping[str, Any]) -> None:
    """PSNR without metal of every case, without and with calibration, a panel a scene."""
    from matplotlib.figure import Figure

    scenes, cases = record["bench"]["scenes"], record["bench"]["cases"]
    figure = Figure(figsize=(3.4 * len(scenes) + 1.6, 3.8), layout="constrained")
    for axis, scene in zip(np.atleast_1d(figure.subplots(1, len(scenes), sharey=True)), scenes):
        for calibrated, colour, label in ((False, QUIET, "as assumed"), (True, ACCENT, "calibrated")):
            values = {
                r["case"]: r["psnr"]
                for r in record["runs"]
                if (r["scene"], r["calibrated"]) == (scene, calibrated)
            }
            places = [cases.index(case) for case in values]
            axis.plot(list(values.values()), places, "o", color=colour, label=label)
        axis.set(title=scene, xlabel="PSNR without metal (dB)")
        axis.set_yticks(range(len(cases)), cases)
        axis.grid(axis="y", alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    figure.axes[0].invert_yaxis()
    figure.axes[0].legend(frameon=False, fontsize=8)
    with replacing(path, overwrite=True) as temporary:
        figure.savefig(temporary, dpi=130, format="png")

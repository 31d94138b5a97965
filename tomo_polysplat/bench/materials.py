"""Which materials the three curves stand in for, by how much they err, and what naming them mends."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tomo_polysplat.bench.environment import environment
from tomo_polysplat.bench.material_rods import RODS, rod_errors, rod_scan
from tomo_polysplat.checks import require_choice, require_number
from tomo_polysplat.files import replacing
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.material_range import LEAST_U
from tomo_polysplat.physics.materials import MaterialLike
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.stand_in import StandIn, best_stand_in
from tomo_polysplat.report.style import ACCENT, QUIET

__all__ = ["MATERIALS", "MaterialsBench", "as_markdown", "run_materials_bench", "write_figure"]

Record = dict[str, Any]

_SOFT = "pmma", "aluminium", "iron"
# Half of the dense curve's content in the middle one makes the mixture linear in u: every dilution is on it.
_IODINE = ("water", {"water": 0.985, "I": 0.015}, {"water": 0.97, "I": 0.03})
# What is measured: its name, what it is made of, whether it is soft matter, and the curves to name for it, if any.
MATERIALS: tuple[tuple[str, MaterialLike, bool, tuple[MaterialLike, ...]], ...] = (
    ("polyethylene", "polyethylene", True, ("polyethylene", "aluminium", "iron")),
    ("adipose", "adipose", True, ("adipose", "aluminium", "iron")),
    ("PMMA", "pmma", True, _SOFT),
    ("muscle", "muscle", True, ("muscle", "aluminium", "iron")),
    ("blood", "blood", True, ("blood", "aluminium", "iron")),
    ("bone", "bone", False, ()),
    ("hydroxyapatite", "hydroxyapatite", False, ()),
    ("aluminium", "aluminium", False, ()),
    ("titanium", "titanium", False, ("water", "aluminium", "titanium")),
    ("stainless steel", "stainless steel", False, ("water", "aluminium", "stainless steel")),
    ("cobalt chrome", "cobalt chrome", False, ("water", "aluminium", "cobalt chrome")),
    ("copper", "copper", False, ("water", "aluminium", "copper")),
    ("zirconia", "zirconia", False, ("water", "aluminium", "zirconia")),
    ("silver", "silver", False, ("water", "aluminium", "silver")),
    ("iodine", "I", False, ("water", "aluminium", "I")),
    ("iodine, 3 % in water", {"water": 0.97, "I": 0.03}, False, _IODINE),
    ("iodine, 1 % in water", {"water": 0.99, "I": 0.01}, False, _IODINE),
    ("barium sulphate", "BaSO4", False, ("water", "aluminium", "BaSO4")),
    (
        "barium sulphate, 20 % in water",
        {"water": 0.8, "BaSO4": 0.2},
        False,
        ("water", {"water": 0.9, "BaSO4": 0.1}, {"water": 0.8, "BaSO4": 0.2}),
    ),
    ("tungsten", "tungsten", False, ("water", "aluminium", "tungsten")),
    ("gold", "gold", False, ("water", "aluminium", "gold")),
    ("lead", "lead", False, ("water", "aluminium", "lead")),
)


@dataclass(frozen=True)
class MaterialsBench:
    """What to measure.

    Attributes
    ----------
    kvp, aluminium_cm : float
        Tube voltage and filter.
    largest : float
        Largest P of the rays.
    size, views : int
        Of the scans of rods that are reconstructed; a size of 0 reconstructs none.
    rods : sequence of str
        Names of ``bench.material_rods.RODS``.
    device : str
    """

    kvp: float = 90.0
    aluminium_cm: float = 0.1
    largest: float = 5.0
    size: int = 40
    views: int = 90
    rods: Sequence[str] = tuple(RODS)
    device: str = "cpu"

    def __post_init__(self) -> None:
        require_number("largest", self.largest, above=0.0)
        require_number("size", self.size, at_least=0)
        for name in self.rods:
            require_choice("rods", name, RODS)
        _ = self.spectrum  # checks its numbers

    @property
    def spectrum(self) -> Spectrum:
        """The tube behind its filter."""
        return Spectrum.from_tube(self.kvp, filters={"Al": self.aluminium_cm}, detector="counting")


def run_materials_bench(
    bench: MaterialsBench,
    *,
    progress: Callable[[str], Any] = lambda _: None,
    update: Callable[[Record], Any] = lambda _: None,
) -> Record:
    """Measure every material, and reconstruct rods of some.

    Parameters
    ----------
    bench : MaterialsBench
    progress, update : callable
        Told in words what comes next; given the record after every rod.

    Returns
    -------
    dict
        JSON-able: ``bench``, ``environment``; ``materials`` with ``name``, ``soft``, ``named`` (the three curves) and
        the stand-ins ``free``, ``held`` (u = 0; soft matter only) and ``own`` as
        :class:`~tomo_polysplat.physics.stand_in.StandIn`; ``rods`` with ``name``, ``named``, ``half_width`` of the
        volume in cm, and the errors of :func:`~tomo_polysplat.bench.material_rods.rod_errors` with the ``default``
        curves and its ``own`` (None where it has none).
    """
    record: Record = {"bench": asdict(bench), "environment": environment(), "materials": [], "rods": []}
    for name, material, soft, named in MATERIALS:
        progress(name)
        record["materials"].append({"name": name, "soft": soft, "named": [_label(m) for m in named]})
        record["materials"][-1] |= _stand_ins(material, soft, Materials(*named) if named else None, bench)
    for name in bench.rods if bench.size else ():
        record["rods"].append(_rods(name, bench, progress))
        update(record)
    return record


def _stand_ins(material: MaterialLike, soft: bool, own: Materials | None, bench: MaterialsBench) -> Record:
    def found(materials: Materials, bounds: tuple[float, float]) -> StandIn:
        return best_stand_in(material, bench.spectrum, materials, largest=bench.largest, bounds=bounds)

    held = asdict(found(Materials(), (0.0, 0.0))) if soft else None
    named = None if own is None else asdict(found(own, (0.0, 0.0) if soft else (LEAST_U, 1.0)))
    return {"free": asdict(found(Materials(), (LEAST_U, 1.0))), "held": held, "own": named}


def _rods(name: str, bench: MaterialsBench, progress: Callable[[str], Any]) -> Record:
    named = RODS[name][2]
    scan = rod_scan(name, bench.spectrum, bench.size, bench.views)
    found: Record = {"name": name, "named": [_label(m) for m in named]}
    found["half_width"] = float(scan.vol_geom["option"]["WindowMaxX"])
    for key, materials in (("default", ()), ("own", named)):
        progress(f"rods of {name}, {key} curves")
        found[key] = rod_errors(scan, materials, bench.device) if materials or key == "default" else None
    return found


def _label(material: MaterialLike) -> str:
    if isinstance(material, str):
        return material
    return " + ".join(f"{100 * share:g} % {part}" for part, share in material.items())


def as_markdown(record: Mapping[str, Any]) -> str:
    """The materials, then the rods."""
    lines = [
        "| material | default, u held at 0 | default, u free | u | rms error of P | named curves | error then |"
    ]
    lines += ["|---|---|---|---|---|---|---|"]
    for entry in record["materials"]:
        free, held = entry["free"], entry["held"]
        cells = ["-" if held is None else _per_cent(held), _per_cent(free), f"{free['u']:.2f}"]
        cells += [f"{free['projection_error']:.1e}", ", ".join(entry["named"]) or "-"]
        cells.append("-" if entry["own"] is None else _per_cent(entry["own"]))
        lines.append(f"| {entry['name']} | {' | '.join(cells)} |")
    if record["rods"]:
        lines += ["", "| rods of | volume, cm | inside, % | mass, % | water, % | PSNR without rods, dB |"]
        lines += ["|---|---|---|---|---|---|"]
        lines += [_rod_row(rod) for rod in record["rods"]]
    return "\n".join(lines) + "\n"


def _rod_row(rod: Mapping[str, Any]) -> str:
    """The errors with the default curves, and with the rods' own."""
    cells = [rod["name"], f"{2 * rod['half_width']:.2g}"]
    columns = (("metal_bias", "+.1f"), ("metal_mass", "+.1f"), ("soft_bias", "+.2f"), ("psnr", ".1f"))
    for key, layout in columns:
        pair = [found[key] for found in (rod["default"], rod["own"]) if found is not None]
        cells.append(" -> ".join("-" if value is None else format(value, layout) for value in pair))
    return f"| {' | '.join(cells)} |"


def _per_cent(stand_in: Mapping[str, float]) -> str:
    return f"{100 * stand_in['attenuation_error']:+.1f} %"


def write_figure(path: Path, record: Mapping[str, Any]) -> None:
    """Errors of the attenuation with the default curves and with named ones."""
    from matplotlib.figure import Figure

    entries: Sequence[Mapping[str, Any]] = record["materials"]
    figure = Figure(figsize=(7.4, 0.26 * len(entries) + 1.2), layout="constrained")
    axis = figure.subplots()
    for key, colour, marker, label in (
        ("held", QUIET, "o", "water, u held at 0 (soft matter's default)"),
        ("free", "#c77c2e", "s", "water, aluminium, iron, u free"),
        ("own", ACCENT, "D", "its own curves named"),
    ):
        points = [(100 * abs(e[key]["attenuation_error"]), n) for n, e in enumerate(entries) if e[key]]
        axis.plot(*zip(*points), marker, color=colour, label=label, markersize=5)
    axis.set_xscale("symlog", linthresh=0.1)
    axis.set_xticks([0, 0.1, 1, 10, 100], ["0", "0.1", "1", "10", "100"])
    axis.set(xlim=(-0.01, 100), xlabel="error of the attenuation at the effective energy (%)")
    axis.set_yticks(range(len(entries)), [entry["name"] for entry in entries])
    axis.invert_yaxis()
    axis.grid(alpha=0.3)
    figure.legend(loc="outside upper center", ncols=2, frameon=False, fontsize=8)
    with replacing(path, overwrite=True) as temporary:
        figure.savefig(temporary, dpi=130, format="png")

"""What the voxels hold: a histogram of the attenuation with the materials named."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.physics.materials import known_density, mass_attenuation
from tomo_polysplat.report.style import INK, QUIET, SAFE, plain_log
from tomo_polysplat.units import cm_per

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from tomo_polysplat.result.data import ResultData

__all__ = ["histogram_figure", "marks"]

_BINS = 160
# Between these material numbers a voxel counts as the middle material.
_MIDDLE = (0.25, 0.75)
# Voxels looked at, evenly spread.
_MOST = 4_000_000
# The least attenuation that is shown, as a share of the largest.
_LEAST = 2e-3


def histogram_figure(result: ResultData) -> Figure:
    """Voxels by their attenuation, both axes logarithmic, stacked by which curve most of their matter follows."""
    from matplotlib.figure import Figure

    step = max(1, result.basis[0].size // _MOST)
    values = np.ravel(result.volume)[::step]
    figure = Figure(figsize=(7.4, 3.0), layout="constrained")
    axis = figure.subplots()
    top = max(float(values.max(initial=0.0)), 1e-6)
    edges = np.geomspace(_LEAST * top, top, _BINS + 1)
    below = np.zeros(_BINS)
    for (label, part), colour in zip(_groups(result, step, values), SAFE):
        count = np.histogram(part, edges)[0]
        axis.stairs(below + count, edges, baseline=below, fill=True, color=colour, label=label)
        below = below + count
    axis.set(yscale="log", ylim=(0.6, 6 * max(below.max(), 1.0)))
    scale = "" if result.energy_kev is None else f" at {result.energy_kev:.1f} keV"
    left = f"; {np.mean(values < edges[0]):.0%} of the voxels hold less than is shown"
    axis.set(xlabel=f"attenuation{scale} (1/{result.unit}){left}", ylabel="voxels")
    axis.spines[["top", "right"]].set_visible(False)
    _mark(axis, result, top)
    plain_log(axis.xaxis)
    axis.legend(frameon=False, fontsize=8, loc="upper left")
    return figure


def _mark(axis: Axes, result: ResultData, top: float) -> None:
    """Lines at what the base materials have at their usual density."""
    for name, place in marks(result):
        if _LEAST * top < place <= 1.5 * top:
            axis.axvline(place, color=INK, linewidth=0.8, linestyle=":")
            beside = axis.get_xaxis_transform()
            axis.text(1.02 * place, 0.97, name, va="top", fontsize=8, color=QUIET, transform=beside)


def _groups(result: ResultData, step: int, values: np.ndarray) -> list[tuple[str, np.ndarray]]:
    """Name and values of the voxels that are mostly of one curve."""
    if result.materials is None:
        return [("all voxels", values)]
    number = np.ravel(result.material)[::step]
    low, high = _MIDDLE
    kinds = (number < low, (number >= low) & (number < high), number >= high)
    names = [material_name(material) for material in result.materials]
    return [(f"mostly {name}-like", values[kind]) for name, kind in zip(names, kinds) if kind.any()]


def material_name(material: Any) -> str:
    """A material's name, or what it is mixed of."""
    return material if isinstance(material, str) else " + ".join(map(str, material))


def marks(result: ResultData) -> list[tuple[str, float]]:
    """The base materials at their usual density, by attenuation in 1/unit at the volume's energy."""
    if result.materials is None or result.energy_kev is None:
        return []
    found = []
    for material in result.materials:
        density = known_density(material)
        if density is not None:
            of_one = float(mass_attenuation(material, result.energy_kev)) * cm_per(result.unit)
            found.append((material_name(material), density * of_one))
    return found

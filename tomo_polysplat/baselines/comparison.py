"""Several reconstructions beside the truth: one table, and one figure for a paper."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.bench.tables import html_table
from tomo_polysplat.checks import fail, require_array, require_shape
from tomo_polysplat.files import replacing
from tomo_polysplat.report.figures import comparison
from tomo_polysplat.report.style import OURS, full_name
from tomo_polysplat.report.table import as_text, cells, headings
from tomo_polysplat.result.metrics import compare as errors_of
from tomo_polysplat.result.result import Result

if TYPE_CHECKING:
    from matplotlib.figure import Figure

__all__ = ["Comparison", "compare"]


@dataclass(frozen=True, eq=False)
class Comparison:
    """What `compare` found. It prints as a table, also in a notebook.

    Attributes
    ----------
    table : list of dict
        ``name``, ``seconds`` (None of an array), ``psnr``, ``psnr_all``, ``ssim`` and ``rmse`` of each volume.
    """

    table: list[dict[str, Any]]
    volumes: dict[str, np.ndarray]
    truth: np.ndarray
    metal: np.ndarray | None
    unit: str
    energy_kev: float | None

    def figure(self, title: str = "One scan, several reconstructions, one grey scale") -> Figure:
        """Slices of all in one window, their errors, and the table, as a matplotlib Figure."""
        panels = list(self.volumes.items())
        about = (self.truth, self.metal, self.unit, self.energy_kev, self.table)
        return comparison(panels, *about, title=title)

    def save(
        self, path: str | os.PathLike, *, title: str | None = None, dpi: int = 200, overwrite: bool = False
    ) -> None:
        """Write the figure, by the name's ending: ``.png``, ``.pdf`` or ``.svg``.

        Raises
        ------
        FileExistsError
            If the file exists and `overwrite` is false.
        """
        with replacing(path, overwrite=overwrite) as temporary:
            figure = self.figure() if title is None else self.figure(title)
            figure.savefig(temporary, dpi=dpi)

    def __str__(self) -> str:
        return as_text(self.table, self.unit)

    def _repr_html_(self) -> str:
        return html_table(headings(self.unit), [cells(entry) for entry in self.table])


def compare(
    truth: np.ndarray,
    volumes: Mapping[str, Result | np.ndarray],
    *,
    metal: np.ndarray | None = None,
    energy_kev: float | None = None,
    unit: str | None = None,
) -> Comparison:
    """Compare reconstructions with the truth.

    Parameters
    ----------
    truth : array, shape (z, y, x), or (y, x) of a 2D scan
        True attenuation in 1/unit.
    volumes : mapping of names to results or arrays
        ``{"FDK": tps.baselines.fdk(scan), "tomo-polysplat": result}``; shaped like the truth.
    metal : bool array shaped like the truth, optional
        Voxels of metal, which most figures of merit leave out.
    energy_kev : float, optional
        Energy of the truth, at which polychromatic results are taken; else that of the first one.
    unit : str, optional
        Of length; that of the results unless told, "cm" where there are only arrays.

    Returns
    -------
    Comparison
        Prints as a table; ``.figure()`` and ``.save("comparison.pdf")`` show it.

    Raises
    ------
    ValueError
        If shapes or units differ, or a volume is not finite.
    """
    if not isinstance(volumes, Mapping) or not volumes:
        raise fail("volumes", "a mapping of names to results or arrays", repr(volumes)[:100])
    truth = _spatial("truth", truth)
    metal = None if metal is None else _spatial("metal", metal).astype(bool)
    results = {name: one for name, one in volumes.items() if isinstance(one, Result)}
    unit = _unit_of(results, unit)
    if energy_kev is None:
        energy_kev = next((one.energy_kev for one in results.values() if not one.is_monochromatic), None)
    table, shown = [], {}
    for given, one in volumes.items():
        name = OURS if given == full_name(OURS) else str(given)
        values = one
        if isinstance(one, Result):
            mixed = not one.is_monochromatic and energy_kev is not None
            values = one.attenuation(float(energy_kev)) if mixed and energy_kev is not None else one.volume
        volume = _spatial(name, values)
        require_shape(name, volume, truth.shape, "(z, y, x) of the truth")
        seconds = one.seconds if isinstance(one, Result) else None
        shown[name] = volume
        table.append({"name": name, "seconds": seconds, **errors_of(volume, truth, metal)})
    return Comparison(table, shown, truth, metal, unit, energy_kev)


def _unit_of(results: Mapping[str, Result], unit: str | None) -> str:
    """The unit that all results have."""
    for name, one in results.items():
        if unit is not None and one.unit != unit:
            raise fail(f"volumes[{name!r}]", f"a volume in 1/{unit}", f"1/{one.unit}")
        unit = one.unit
    return unit or "cm"


def _spatial(name: str, volume: Any) -> np.ndarray:
    """(z, y, x) with y ascending."""
    array = require_array(name, volume)
    if array.ndim == 2:
        return array[None, ::-1]
    return require_array(name, array, 3)

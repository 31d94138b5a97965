"""A filter that is not everywhere as thick, such as a bowtie: each pixel has a spectrum of its own.

The open beam is measured through the filter too, so that a pixel behind so much of it (g/cm2) measures, relative to its
own open beam,

    P(a, t) = -log sum_E eta(E) exp(-a b(E) - t f(E)) + log sum_E eta(E) exp(-t f(E)).

Known matter in front of the object: one curve more, whose areal density is given for each pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_number
from tomo_polysplat.physics.beer_lambert import projection
from tomo_polysplat.physics.filtered_rays import Behind
from tomo_polysplat.physics.materials import MaterialLike, density, mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.units import cm_per

if TYPE_CHECKING:
    import torch

__all__ = ["FilterMap", "measured_filter", "require_filter_map"]

# Thicknesses and values of the table by which rays are seen as if without the filter, and rays looked up at once.
_LEVELS, _VALUES, _CHUNK = 65, 2049, 1 << 22
_REMEDY = "pass filter_map=('Al', thickness), an array (rows, columns) in the scan's unit"


def require_filter_map(value: Any) -> tuple[str, np.ndarray, float]:
    """Material, thickness (rows, columns) as float32 in the caller's unit, and density in g/cm3, checked.

    Parameters
    ----------
    value : (material, thickness) or (material, thickness, density)
        A row of thicknesses stands for all rows; the density is that of the material if it is not given.

    Raises
    ------
    ValueError, TypeError
        For an unknown material, or thicknesses that are negative or no numbers.
    """
    if not isinstance(value, Sequence) or isinstance(value, str) or len(value) not in (2, 3):
        raise fail(
            "filter_map", "a material and its thickness at each pixel", repr(value), _REMEDY, TypeError
        )
    material = value[0]
    grams = (
        require_number("filter_map's density", value[2], above=0.0) if len(value) == 3 else density(material)
    )
    thickness = np.atleast_2d(require_array("filter_map's thickness", value[1])).astype(np.float32)
    if thickness.ndim != 2 or not thickness.size:
        raise fail("filter_map's thickness", "(rows, columns)", f"shape {thickness.shape}", _REMEDY)
    if not (np.isfinite(thickness).all() and (thickness >= 0).all()):
        raise fail("filter_map's thickness", "no negative value and no NaN", "some", _REMEDY)
    return material, thickness, float(grams)


def measured_filter(
    material: str, with_filter: Any, without: Any, spectrum: Spectrum, unit: str = "cm"
) -> tuple[str, np.ndarray, float]:
    """The map of a filter from the open beam with it and without it.

    Parameters
    ----------
    material : str
        With a known density.
    with_filter, without : (rows, columns) array_like
        Counts, their dark counts taken off.
    spectrum : Spectrum
        In front of the filter.
    unit : str
        Of the scan the map is for.

    Returns
    -------
    (material, thickness, density)
        As `tomo_polysplat.reconstruct` takes it. What looks thinner than nothing is 0.

    Raises
    ------
    ValueError
        For counts that are not above 0.
    """
    counts = [
        require_array(n, v, 2).astype(np.float64)
        for n, v in (("with_filter", with_filter), ("without", without))
    ]
    if not all((part > 0).all() and np.isfinite(part).all() for part in counts):
        raise fail(
            "with_filter, without",
            "counts above 0",
            "others",
            "take the dark counts off, and mend bad pixels",
        )
    from tomo_polysplat.physics.water import areal_density

    grams = density(material)
    areal = areal_density(np.log(counts[1] / counts[0]), spectrum, material)
    return material, np.maximum(areal / (grams * cm_per(unit)), 0.0).astype(np.float32), grams


@dataclass(frozen=True, eq=False)
class FilterMap:
    """How much of a filter each pixel sees.

    Attributes
    ----------
    material : str
    areal : (rows, columns) float32 array
        In g/cm2.
    grams : float
        Density in g/cm3, for reports.
    reach : float
        Areal density in g/cm2 up to which nodes of a spectrum have to hold, where that is more than the map has.
    """

    material: str
    areal: np.ndarray
    grams: float
    reach: float = 0.0

    @classmethod
    def of(cls, value: Any, unit: str, rows: int, columns: int) -> FilterMap:
        """That of `require_filter_map`'s ``value`` for a detector of so many pixels.

        Raises
        ------
        ValueError, TypeError
            As there, for another detector, and for lengths in pixels.
        """
        material, thickness, grams = require_filter_map(value)
        if unit == "pixel":
            raise fail("filter_map", "lengths in a real unit beside it", "unit='pixel'", "pass unit=")
        if thickness.shape == (1, columns):
            thickness = np.repeat(thickness, rows, axis=0)
        if thickness.shape != (rows, columns):
            expected = f"a thickness of shape {(rows, columns)}, (rows, columns) of the detector"
            raise fail("filter_map", expected, f"{thickness.shape}", _REMEDY)
        return cls(material, np.ascontiguousarray(thickness * (grams * cm_per(unit)), np.float32), grams)

    @property
    def span(self) -> Behind:
        """What nodes of a spectrum have to hold for."""
        least, most = self.ends
        return self.material, least, max(most, self.reach)

    @property
    def ends(self) -> tuple[float, float]:
        """Least and largest areal density, g/cm2."""
        return float(self.areal.min()), float(self.areal.max())

    def attenuation(self, energies: np.ndarray) -> np.ndarray:
        """(n,) mass attenuation in cm2/g."""
        return mass_attenuation(self.material, energies)

    def describe(self) -> str:
        """One phrase for reports."""
        least, most = (end / self.grams for end in self.ends)
        return f"{least:.3g} to {most:.3g} cm of {self.material}"

    def joined(self, rows: int, columns: int) -> FilterMap:
        """That of pixels of so many rows and columns together; the rest at the far ends is dropped."""
        height, width = self.areal.shape[0] // rows, self.areal.shape[1] // columns
        parts = self.areal[: height * rows, : width * columns].reshape(height, rows, width, columns)
        return replace(self, areal=parts.mean(axis=(1, 3), dtype=np.float64).astype(np.float32))

    def dimmed(self, spectrum: Spectrum) -> np.ndarray:
        """(rows, columns) float32: -log of the share of the open beam that passes the filter."""
        lit = spectrum.weights > 0
        curve = self.attenuation(spectrum.energies[lit])[None]
        # By a table, dense near the least, as each pixel has many energies.
        least, most = self.ends
        places = least + (most - least) * np.linspace(0.0, 1.0, _VALUES) ** 3
        values = projection(places[None], np.log(spectrum.weights[lit]), curve)
        return np.interp(self.areal, places, values).astype(np.float32)

    def as_if_bare(self, values: torch.Tensor, spectrum: Spectrum, soft: MaterialLike) -> torch.Tensor:
        """What the rays would measure without the filter, were the object all of one material.

        Parameters
        ----------
        values : (views, rows, columns) tensor
            ``-log(I / I0)`` relative to the open beam behind the filter; NaN is kept.
        spectrum : Spectrum
            Of the tube, in front of the filter.
        soft : str or mapping
            The material.
        """
        import torch

        largest = max(float(values.nan_to_num(nan=0.0, posinf=0.0, neginf=0.0).max()), 1.0)
        table, slopes = self._table(largest, spectrum, soft)
        least, most = self.ends
        place = torch.from_numpy(self.areal).to(values.device).double()
        place = (place - least) * ((_LEVELS - 1) / max(most - least, 1e-12))
        level = place.clamp(0, _LEVELS - 2).long()
        share = place - level
        bare, slope = (torch.from_numpy(part).to(values.device) for part in (table.ravel(), slopes))
        slope = torch.lerp(slope[level], slope[level + 1], share)
        made, scale = torch.empty_like(values), (_VALUES - 1) / largest ** (1 / 3)
        many = max(1, _CHUNK // values[0].numel())
        for part, to in zip(values.split(many), made.split(many)):
            at = part.double().clamp(min=0).pow_(1 / 3).mul_(scale)
            index = at.nan_to_num(0).clamp_(max=_VALUES - 2).long()
            at -= index
            index += level * _VALUES
            low = torch.lerp(bare[index], bare[index + 1], at)
            index += _VALUES
            high = torch.lerp(bare[index], bare[index + 1], at)
            to.copy_(torch.where(part < 0, part * slope, torch.lerp(low, high, share.expand_as(low))))
        return made

    def _table(self, largest: float, spectrum: Spectrum, soft: MaterialLike) -> tuple[np.ndarray, np.ndarray]:
        """P without the filter by level of it and by evenly spaced cube roots of P behind it; and dP/dP at 0."""
        lit = spectrum.weights > 0
        energies, logs = spectrum.energies[lit], np.log(spectrum.weights[lit])
        curve, own = mass_attenuation(soft, energies)[None], self.attenuation(energies)
        # P rises at least as fast as at the energy that penetrates best.
        paths = largest / float(curve.min()) * np.linspace(0.0, 1.0, _VALUES) ** 3
        bare = projection(paths[None], logs, curve)
        wanted = largest * np.linspace(0.0, 1.0, _VALUES) ** 3
        table, slopes, share = np.empty((_LEVELS, _VALUES)), np.empty(_LEVELS), np.exp(logs)
        for k, areal in enumerate(np.linspace(*self.ends, _LEVELS)):
            behind = logs - areal * own
            behind = behind - np.logaddexp.reduce(behind)
            table[k] = np.interp(wanted, projection(paths[None], behind, curve), bare)
            slopes[k] = (curve[0] @ share) / (curve[0] @ np.exp(behind))
        # Exactly 0 without matter, whatever the sums were rounded to.
        table[:, 0] = 0.0
        return table, slopes

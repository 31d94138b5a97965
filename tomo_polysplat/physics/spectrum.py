"""The detected x-ray spectrum: tube, filters and detector response in one normalised set of weights."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail, require_array, require_number, require_shape, visible
from tomo_polysplat.physics.detector import Detector
from tomo_polysplat.physics.filter_text import FILTER_REMEDY, require_filters
from tomo_polysplat.physics.materials import density, mass_attenuation, require_energies
from tomo_polysplat.physics.tube_tables import anode_symbol, tube_counts

__all__ = ["Filters", "Spectrum", "require_energy_of", "require_spectrum"]

logger = logging.getLogger(__name__)

# material -> thickness in cm, or (thickness in cm, density in g/cm3); or words, such as "Al 1mm"
Filters = Mapping[str, float | tuple[float, float]] | str

_SUPPORT = 1e-4  # of the largest weight per keV; weaker ends do not count as support


class Spectrum:
    """Detected spectrum ``eta(E)``, the share of the unattenuated signal that each energy contributes.

    The measurement it belongs to is ``P = -log sum_E eta(E) exp(-integral of mu(E))``.

    Parameters
    ----------
    energies_kev : (n,) array_like
        Energies in keV, in any order. Weights at the same energy are added.
    weights : (n,) array_like
        Signal at each energy (the whole bin's, not per keV), detector response included: non-negative, in any
        unit, since they are normalised to add up to 1. Zeros at both ends are dropped.
    label : str
        Where it comes from, for reports.

    Raises
    ------
    ValueError
        For different lengths, NaN, negative weights, weights that are all 0, or energies outside 0.1-800 keV.
    """

    __slots__ = ("_energies", "_label", "_weights")

    def __init__(self, energies_kev: Any, weights: Any, label: str = "measured spectrum") -> None:
        energies = require_array("energies_kev", energies_kev, ndim=1).astype(np.float64)
        values = require_array("weights", weights, ndim=1).astype(np.float64)
        require_shape("weights", values, energies.shape, "(energies,)", "one weight for each energy")
        if not (np.isfinite(energies).all() and np.isfinite(values).all()):
            raise fail("spectrum", "finite energies and weights", "NaN or infinity")
        if (values < 0).any():
            raise fail("weights", "no negative value", f"{values.min():g}", "clip the measured spectrum at 0")
        if not values.any():
            raise fail("weights", "at least one above 0", "only zeros")
        energies, position = np.unique(energies, return_inverse=True)
        values = np.bincount(position, values).astype(np.float64)
        used = np.flatnonzero(values)
        inside = slice(used[0], used[-1] + 1)
        self._energies = require_energies("energies_kev", energies[inside])
        total = values.sum()
        # Normalising twice would change the last digits, and a spectrum must survive saving unchanged.
        self._weights = values[inside] / (total if abs(total - 1.0) > 1e-12 else 1.0)
        self._label = visible(label)
        self._energies.flags.writeable = self._weights.flags.writeable = False

    @classmethod
    def monochromatic(cls, kev: float) -> Spectrum:
        """A single energy.

        Parameters
        ----------
        kev : float
            In keV.

        Raises
        ------
        ValueError
            For an energy outside the tables, 0.1-800 keV.
        """
        return cls(require_energies("kev", [require_number("kev", kev, above=0.0)]), [1.0], "monochromatic")

    @classmethod
    def from_tube(
        cls,
        kvp: float,
        anode: str = "W",
        filters: Filters | None = None,
        detector: Detector | str | None = None,
    ) -> Spectrum:
        """Spectrum of an x-ray tube from the packaged tables (SpekPy, 12 degree anode).

        Parameters
        ----------
        kvp : float
            Tube voltage, 20 to 450 kV for tungsten, 20 to 50 kV for the other anodes.
        anode : str
            ``"W"``, ``"Mo"``, ``"Rh"``, ``"Ag"``, ``"Cu"`` or ``"Au"``.
        filters : str or mapping, optional
            Everything between anode and sample, as ``"Al 1mm"`` or ``"Be 0.5mm + Cu 0.1mm"``, as ``{material: cm}``,
            or ``{material: (cm, g/cm3)}`` for one without a known density. The tube's
            own window belongs here too, such as ``{"Be": 0.05, "Al":
            0.1}``: without any, the tube is bare and most of its photons are too soft for any sample. The log
            warns of that unless it is asked for, by ``{}``.
        detector : Detector or str, optional
            Response, or its name as in :meth:`Detector.named`, such as ``"csi:0.6mm"``. None counts every photon, and
            the log warns of that unless it is asked for, by ``"counting"``.

        Raises
        ------
        ValueError
            For a voltage or anode outside the tables, or an unknown filter material.
        """
        kvp = require_number("kvp", kvp)
        anode = anode_symbol(anode)
        tube = cls(*tube_counts(kvp, anode), label=f"{kvp:g} kVp {anode} tube")
        if filters is None:
            logger.warning(
                "No filter was given: the %s is bare, of %.0f keV in the mean. Pass what lies between anode and sample,"
                " its window too, as filters='Al 1mm' or --filter 'Al 1mm'; filters={} or none if there is nothing.",
                tube.label,
                tube.effective_energy,
            )
        if detector is None:
            logger.warning(
                "No detector was given: it is taken to count every photon, which a flat panel does not. Pass "
                "detector='csi:0.6mm' or --detector csi:0.6mm, or whatever it is; 'counting' if it counts them."
            )
        spectrum = tube.filtered({} if filters is None else filters)
        return spectrum.detected("counting" if detector is None else detector)

    def filtered(self, filters: Filters) -> Spectrum:
        """This spectrum behind more filters, each of which takes away ``exp(-mu t)``.

        Parameters
        ----------
        filters : str or mapping
            ``"Al 1mm"``, ``{material: cm}``, or ``{material: (cm, g/cm3)}`` for one without a known density.

        Raises
        ------
        ValueError, TypeError
            For an unknown material, a negative thickness, or what is no mapping.
        """
        if isinstance(filters, str):
            filters = require_filters("filters", filters)
        if not isinstance(filters, Mapping):
            raise fail("filters", "a dict of material and cm", repr(filters), FILTER_REMEDY, TypeError)
        exponent = np.zeros_like(self._energies)
        for material, amount in filters.items():
            thickness, grams = amount if isinstance(amount, tuple) and len(amount) == 2 else (amount, None)
            thickness = require_number(
                f"filters[{material!r}]", thickness, at_least=0.0, remedy="a thickness in cm"
            )
            if thickness > 0:
                grams = (
                    density(material) if grams is None else require_number("filter density", grams, above=0.0)
                )
                exponent += thickness * grams * mass_attenuation(material, self._energies)
        # Relative to the most penetrating energy: a heavy filter must not underflow every weight.
        lit = self._weights > 0
        weights = self._weights * np.exp(np.where(lit, exponent[lit].min() - exponent, 0.0))
        amounts = [f"{f'{a[0]:g}' if isinstance(a, tuple) else f'{a:g}'} cm {m}" for m, a in filters.items()]
        return Spectrum(self._energies, weights, " + ".join([self._label, *amounts]))

    def detected(self, detector: Detector | str) -> Spectrum:
        """This spectrum of photons as seen by a detector.

        Parameters
        ----------
        detector : Detector or str
            A name is as in :meth:`Detector.named`.

        Raises
        ------
        ValueError, TypeError
            For a detector that sees none of it, or what is no `Detector`.
        """
        if isinstance(detector, str):
            detector = Detector.named(detector)
        if not isinstance(detector, Detector):
            raise fail("detector", "a Detector or its name", repr(detector), "such as 'csi:0.6mm'", TypeError)
        weights = self._weights * detector.response(self._energies)
        if not weights.any():
            raise fail(
                "detector", "one that sees some of the spectrum", detector.describe(), "lower its threshold"
            )
        return Spectrum(self._energies, weights, f"{self._label}, {detector.describe()}")

    @property
    def energies(self) -> np.ndarray:
        """Energies ``(n,)`` in keV, ascending, float64, read-only."""
        return self._energies

    @property
    def weights(self) -> np.ndarray:
        """Weights ``(n,)`` that add up to 1, float64, read-only."""
        return self._weights

    @property
    def label(self) -> str:
        """Where it comes from."""
        return self._label

    @property
    def effective_energy(self) -> float:
        """``sum eta(E) E`` in keV: the energy at which volumes are given."""
        return float(self._weights @ self._energies)

    @property
    def is_monochromatic(self) -> bool:
        """Whether all weight sits at one energy."""
        return self._energies.size == 1

    def sampled(self, n: int) -> Spectrum:
        """Plain sampling: ``n`` equally spaced points over the support, weighted by the density there.

        The usual way to cut the number of energies, kept for comparisons: ``fit_quadrature`` needs far fewer.
        The support is where the weight per keV exceeds 1e-4 of its maximum.

        Parameters
        ----------
        n : int
            Points, 1 at least.

        Raises
        ------
        ValueError
            For fewer.
        """
        n = int(require_number("n", n, at_least=1))
        if self.is_monochromatic:
            return self
        per_kev = self._weights / np.gradient(self._energies)
        support = self._energies[per_kev >= _SUPPORT * per_kev.max()]
        points = np.linspace(support[0], support[-1], n) if n > 1 else np.array([self.effective_energy])
        return Spectrum(points, np.interp(points, self._energies, per_kev), f"{self._label}, {n} samples")

    def describe(self) -> str:
        """One line for reports."""
        if self.is_monochromatic:
            return f"{self._label}: {self._energies[0]:g} keV"
        span = f"{self._energies[0]:g}-{self._energies[-1]:g} keV"
        effective = f"effective {self.effective_energy:.1f} keV"
        return f"{self._label}: {self._energies.size} energies, {span}, {effective}"

    def to_dict(self) -> dict[str, Any]:
        """Plain lists and strings, for JSON; see ``from_dict``."""
        return {
            "energies_kev": self._energies.tolist(),
            "weights": self._weights.tolist(),
            "label": self._label,
        }

    @classmethod
    def from_dict(cls, content: Mapping[str, Any]) -> Spectrum:
        """The inverse of ``to_dict``.

        Raises
        ------
        ValueError
            For a dict without energies or weights, and as the class itself does.
        """
        missing = {"energies_kev", "weights"} - set(content)
        if missing:
            raise fail("spectrum", "energies_kev and weights", f"no {' or '.join(sorted(missing))}")
        return cls(content["energies_kev"], content["weights"], content.get("label", "measured spectrum"))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Spectrum):
            return NotImplemented
        same = np.array_equal(self._energies, other._energies) and np.array_equal(
            self._weights, other._weights
        )
        return same and self._label == other._label

    def __hash__(self) -> int:
        return hash((self._energies.tobytes(), self._weights.tobytes(), self._label))

    def __repr__(self) -> str:
        return f"<Spectrum {self.describe()}>"


def require_energy_of(argument: str, kev: Any, spectrum: Spectrum | None) -> float:
    """An energy in keV at which a volume that was fitted under a spectrum is known.

    Raises
    ------
    ValueError, TypeError
        For none within the tables, no spectrum, or another energy than a spectrum's only one.
    """
    energy = require_number(argument, kev, above=0.0)
    if spectrum is None:
        raise fail(argument, "a spectrum beside it", f"{energy:g} keV alone", "pass the scan's spectrum")
    if spectrum.is_monochromatic and abs(energy - spectrum.energies[0]) > 1e-6 * energy:
        raise fail(argument, f"{spectrum.energies[0]:g} keV, the spectrum's only energy", f"{energy:g}")
    require_energies(argument, [energy])
    return energy


def require_spectrum(argument: str, value: Any) -> Spectrum | None:
    """A spectrum, or None; a voltage, a name or a dict is none.

    Raises
    ------
    TypeError
        With how to make one.
    """
    if value is None or isinstance(value, Spectrum):
        return value
    remedy = "make one, as Spectrum.from_tube(90, filters='Al 1mm', detector='csi:0.6mm')"
    raise fail(argument, "a Spectrum or None", repr(value), remedy, TypeError)

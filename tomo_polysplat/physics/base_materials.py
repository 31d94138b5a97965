"""The three base materials of a scene, whose attenuation curves a material number mixes."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from tomo_polysplat.checks import fail
from tomo_polysplat.physics.materials import (
    MaterialLike,
    composition,
    known_density,
    mass_attenuation,
    require_energies,
)

__all__ = ["Materials"]

logger = logging.getLogger(__name__)

# In mass attenuation. Of bone and soft matter, which may be named in any order, it is 2.4 at 40 keV.
_BY_FAR = 3.0


@dataclass(frozen=True, eq=False)
class Materials:
    """The three base materials whose attenuation curves a scene mixes.

    A Gaussian's material ``u`` in [0, 1] stands for the curve
    ``(1-u)^2 soft + 2u(1-u) middle + u^2 dense``. The defaults suit tissue, bone and the common metals; a
    material with an absorption edge inside the spectrum (Ag, I, Ba) should be one of the three where it
    occurs. The first is what most of the object is made of, the last the heaviest.

    Parameters
    ----------
    soft, middle, dense : str or mapping
        Anything ``mass_attenuation`` accepts.

    Raises
    ------
    ValueError
        For an unknown material.
    """

    soft: MaterialLike = "water"
    middle: MaterialLike = "aluminium"
    dense: MaterialLike = "iron"

    def __post_init__(self) -> None:
        for material in self:
            composition(material)

    def __iter__(self) -> Iterator[MaterialLike]:
        return iter((self.soft, self.middle, self.dense))

    def __eq__(self, other: object) -> bool:
        """Whether they are the same matter, however it is spelt: of the same elements and the same density."""
        if not isinstance(other, Materials):
            return NotImplemented
        return self._matter == other._matter

    def __hash__(self) -> int:
        return hash(self._matter)

    @cached_property
    def _matter(self) -> tuple[Any, ...]:
        return tuple((composition(material), known_density(material)) for material in self)

    @classmethod
    def of(cls, value: Materials | Sequence[MaterialLike] | None) -> Materials:
        """From what a caller may hand over.

        Parameters
        ----------
        value : Materials, sequence of three materials, or None
            None: the defaults.

        Raises
        ------
        ValueError
            For anything else, or an unknown material.
        """
        if value is None:
            return cls()
        if isinstance(value, Materials):
            return value
        if isinstance(value, (str, Mapping)) or not hasattr(value, "__len__") or len(value) != 3:
            raise fail("materials", "three materials (soft, middle, dense)", repr(value))
        return cls(*value)

    @classmethod
    def under(
        cls, value: Materials | Sequence[MaterialLike] | None, energy_kev: float | None
    ) -> Materials | None:
        """Those for a spectrum of this effective energy; None for one energy, which has no use for any.

        The log tells of materials that are not used, and of the densest in the first place.
        """
        materials = cls.of(value)
        if energy_kev is None:
            if value is not None:
                logger.warning("The materials %s are not used: there is one energy.", list(materials))
            return None
        first, *others = materials.mass_attenuation([energy_kev])[:, 0]
        if first > _BY_FAR * max(others):
            words = "takes away most x-rays: they are soft, middle, dense, in this order"
            logger.warning("The first of the materials %s %s.", list(materials), words)
        return materials

    def mass_attenuation(self, energies_kev: Any) -> np.ndarray:
        """Curves ``(3, n)`` in cm2/g, float64, of soft, middle and dense.

        Parameters
        ----------
        energies_kev : (n,) array_like
            Energies in keV.

        Raises
        ------
        ValueError
            For energies outside the tables, 0.1-800 keV.
        """
        energies = np.atleast_1d(require_energies("energies_kev", energies_kev))
        return np.stack([mass_attenuation(material, energies) for material in self])

    @staticmethod
    def mixture(u: Any) -> np.ndarray:
        """Shares ``[(1-u)^2, 2u(1-u), u^2]`` of the three curves, ``(3, ...)`` for ``u`` of any shape."""
        u = np.asarray(u, dtype=np.float64)
        return np.stack([(1.0 - u) ** 2, 2.0 * u * (1.0 - u), u**2])

    def mixed(self, u: float) -> Mapping[str, float]:
        """The material of a number from 0 to 1, as mass fractions of elements."""
        shares: dict[str, float] = {}
        for share, material in zip(self.mixture(u), self):
            for symbol, fraction in composition(material):
                shares[symbol] = shares.get(symbol, 0.0) + float(share) * fraction
        return shares

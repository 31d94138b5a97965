"""Scattered light as a nuisance: a level, and a share of the light around a ray (`physics.scatter`)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from tomo_polysplat.nuisances.light_gate import MARGIN, light_gate
from tomo_polysplat.nuisances.nuisance import Found, Nuisance, Parameter, Place, Verdict
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.ray_estimates import FittedRays, estimate_scatter, misfit_left
from tomo_polysplat.physics.scatter import LARGEST_SCATTER, Scatter
from tomo_polysplat.physics.spectrum import Spectrum

__all__ = ["ScatteredLight", "Shown"]

# Beside the object, views that differ by more than this share of the most scatter tell of a drifting beam.
_DRIFT = 0.3
_ASKED = "calibrate=True fits it all the same"
# Scatter adds to every ray. So many rays, and such a share of them, may be darker than it by some fault of theirs.
_FEW_DARKER, _DARKER_SHARE = 7, 1.5e-4


class Shown(NamedTuple):
    """What the residuals of rays show.

    Attributes
    ----------
    scatter : Scatter
    beam : float
        Its brightness, in those that were assumed.
    left : float
        How much of the rays' misfit is left under both.
    """

    scatter: Scatter
    beam: float
    left: float


class ScatteredLight(Nuisance):
    """Light on top of what passes, a level and a share of the light around each ray."""

    name = "scatter"
    place = Place.LIGHT
    parameters = {
        "scatter": Parameter("of the open beam", 0.0, 0.0, LARGEST_SCATTER),
        "scatter_of_light": Parameter("of the light around a ray", 0.0, -LARGEST_SCATTER, LARGEST_SCATTER),
    }
    found_by = Found.RESIDUALS
    gauge = "matter that took up some of the scatter: one factor for each curve's amount is fitted beside it"
    cost = "two to nine short fits"

    @classmethod
    def gate(cls, evidence: Mapping[str, float]) -> Verdict:
        """The held-out rays fit 3 % better. Unasked, the darkest do so too, and better than the beam alone explains."""
        if not cls.possible(evidence):
            return Verdict(False, f"{evidence['darker']:.0f} of {evidence['rays']:.0f} rays have less light")
        return light_gate(evidence, rival="the beam that rays beside the object show")

    @classmethod
    def suspected(cls, evidence: Mapping[str, float]) -> Verdict:
        """Whether rays of a run that nobody has told of scatter ask for short fits.

        Parameters
        ----------
        evidence : mapping of str to float
            ``most``, the most scatter in any ray, as a fraction of the open beam; ``left``, how much of the rays'
            misfit it would leave; ``drift``, by how much the views' light beside the object differs, missing where too
            few rays tell it.
        """
        most, drift = evidence["most"], evidence.get("drift")
        # What short fits would have to confirm.
        if evidence["left"] > 1 - MARGIN:
            less = f"which takes {1 - evidence['left']:.1%} off their misfit"
            return Verdict(False, f"the rays show {most:.1g} of the open beam at most, {less}")
        if drift is None:
            words = "too few rays pass beside the object to tell it from a drifting beam"
            return Verdict(False, f"the rays may show {most:.2g} of the open beam, but {words}; {_ASKED}")
        if drift > _DRIFT * most:
            words = "the light beside the object differs from view to view, as that of a drifting beam does"
            return Verdict(False, f"{words}; {_ASKED}")
        return Verdict(True, f"the rays may show {most:.2g} of the open beam")

    @classmethod
    def possible(cls, evidence: Mapping[str, float]) -> bool:
        """Whether no more rays are darker than the scatter than by a fault of theirs."""
        return evidence.get("darker", 0) <= max(_FEW_DARKER, _DARKER_SHARE * evidence.get("rays", 0))

    @classmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """The level."""
        scatter = cls.of(values)
        if not (scatter.constant or scatter.of_light):
            return ""
        return f"scatter of {scatter.constant:.2g} of the open beam"

    @classmethod
    def of(cls, values: Mapping[str, Any]) -> Scatter:
        """The scatter of parameters by name."""
        return Scatter(float(values.get("scatter", 0.0)), float(values.get("scatter_of_light", 0.0)))

    @classmethod
    def describe(cls, values: Mapping[str, Any]) -> str:
        """Both parameters in words."""
        scatter = cls.of(values)
        words = f"{scatter.constant:.4g} of the open beam"
        return words + (f" and {scatter.of_light:.4g} of the light around a ray" if scatter.varies else "")

    @classmethod
    def shown(
        cls, level: float, sample: FittedRays, spectrum: Spectrum | None, materials: Materials | None
    ) -> list[Shown]:
        """What the residuals of rays show: scatter alone, and with another beam where that explains more.

        A source that is dimmer than its open field hides scatter beside the object, but not behind it.

        Parameters
        ----------
        level : float
            Constant scatter that the fit assumed.
        sample : FittedRays
        spectrum, materials : Spectrum, Materials, or None
            See `physics.ray_estimates.FittedRays.under`.
        """
        rays, found = sample.under(spectrum, materials), []
        for free in (False, True):
            scatter, beam = estimate_scatter(rays, level, beam_free=free)
            left = misfit_left(rays, Scatter(level), scatter, beam_free=free)
            found.append(Shown(scatter, beam, left))
        alone, both = found
        # Of faint matter scatter, the beam and the amounts explain the same: the most that there is, is no finding.
        told = both.scatter.constant < LARGEST_SCATTER and both.left < (1 - MARGIN) * alone.left
        return found if told else [alone]

    @classmethod
    def moved(
        cls,
        was: Scatter,
        level: float,
        sample: FittedRays,
        spectrum: Spectrum,
        materials: Materials,
    ) -> list[dict[str, float]]:
        """The parameters where the residuals of rays say that they are; none where that is where they were.

        Parameters
        ----------
        was : Scatter
            That was assumed.
        level : float
            Constant scatter that the rays have in its place (`physics.scatter.made_level`).
        sample : FittedRays
        spectrum : Spectrum
        materials : Materials

        Returns
        -------
        list of dict
            One for each that they show; with ``beam``, in beams that were assumed, where that is another.
        """
        places = []
        for found in cls.shown(level, sample, spectrum, materials):
            if found.left > 1 - MARGIN:
                continue
            new = Scatter(
                was.constant + found.scatter.constant - level, was.of_light + found.scatter.of_light
            )
            values = {"scatter": new.constant} | ({"scatter_of_light": new.of_light} if new.varies else {})
            places.append(values if found.beam == 1.0 else values | {"beam": found.beam})
        return places

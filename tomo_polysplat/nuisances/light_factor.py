"""What gains and drift have in common: they stay as they are, and residuals of short fits tell them."""

from __future__ import annotations

from collections.abc import Mapping

from tomo_polysplat.nuisances.nuisance import Found, Nuisance, Verdict

__all__ = ["WORTH", "LightFactor"]

# In standard errors of the mean difference, each ray with the correction and without.
_SURE = 3.0
# Of the misfit: a smaller gain is worth no correction, however sure it is (of 3.6e9 rays a drift of 0.002 % is).
WORTH = 1e-3


class LightFactor(Nuisance):
    """Factors of the light, found by what a fit leaves of the rays."""

    found_by = Found.RESIDUALS

    @classmethod
    def gate(cls, evidence: Mapping[str, float]) -> Verdict:
        """Whether the misfit of held-out rays falls by three times its standard error at least, and by a per mille.

        Parameters
        ----------
        evidence : mapping of str to float
            ``rms`` of what was found; ``better``, by what share the mean misfit of the held-out rays falls with it, and
            ``error``, the standard error of that.
        """
        if not evidence["rms"] > 0:
            return Verdict(False, "none beyond the noise")
        better, error = evidence["better"], evidence["error"]
        way = "rises" if better < 0 else "falls"
        words = f"the misfit of held-out rays {way} by {abs(better):.1%} (standard error {error:.1%})"
        return Verdict(better > max(_SURE * error, WORTH), f"{evidence['rms']:.2%} rms; {words}")

    @classmethod
    def ruled_out(cls, evidence: Mapping[str, float], part: float, worth: float = WORTH) -> bool:
        """Whether all views, of which this ``part`` gave the evidence, would take away no more than ``worth``.

        A mean over m of n views has n / m times the variance of noise, and so much less of it is believed: what all
        of them confirm takes away at least m / n of that here. NaN, of too few rays, rules nothing out.
        """
        return evidence["better"] + _SURE * evidence["error"] <= part * worth

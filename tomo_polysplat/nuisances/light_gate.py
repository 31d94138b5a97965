"""The gate that scatter and a brighter beam have in common, as each is asked against the other."""

from __future__ import annotations

import math
from collections.abc import Mapping

from tomo_polysplat.nuisances.nuisance import Verdict

__all__ = ["MARGIN", "light_gate", "more_likely"]

# Held-out errors of two fits of the same scan under nearly the same physics, with one seed, differ by up to 2 %.
MARGIN = 0.03
# Scatter, and a brighter beam, have to explain the darkest rays by so much better than each other. Scatter of 1 and 2 %
# in scenes with metal did by 8 to 36 %; beams 1 % brighter are taken for scatter where iron is opaque (10 and 12 %).
_DARKER = 0.05
# With so small a share of the other's held-out error the darkest rays need not tell: they are few, and a short fit of
# metal is rough (bronze at 220 kV, 3 % of scatter: 0.42; beams 1 % brighter, taken for scatter: 0.90).
_FAR_BETTER = 0.7
# The darkest rays tell where so much of their light would be scatter, times the root of their number: else their noise
# does. Of a slice of soft matter 23 of them come to 0.5, of slices with metal to 1 to 4, of volumes to 2 to 9.
_SIGNAL = 1.0


def light_gate(evidence: Mapping[str, float], rival: str, *, darkest_margin: bool = False) -> Verdict:
    """Whether the rays confirm more light than what passes.

    Parameters
    ----------
    evidence : mapping of str to float
        ``held_out_before`` and ``held_out_after``, the errors of the held-out rays. Where the rays alone ask for it,
        ``darkest_before`` and ``darkest_after``, those of the rays with the least light; and of a fit by what looks
        alike, if there is one, ``held_out_rival`` and ``darkest_rival``. ``darkest_rays`` is how many these are, and
        ``darkest_share`` how much of their light would be scatter.
    rival : str
        What looks alike, in words.
    darkest_margin : bool
        Whether the darkest rays may fit as well as before, and need not tell where all rays fit far better.
    """
    if not evidence["held_out_after"] < (1 - MARGIN) * evidence["held_out_before"]:
        return Verdict(False, f"the held-out rays do not fit {MARGIN:.0%} better")
    asked = "darkest_before" in evidence and _darkest_tell(evidence)
    if asked and not (darkest_margin and _far_better(evidence, "before")):
        most = evidence["darkest_before"] * (1 + MARGIN if darkest_margin else 1.0)
        if not evidence["darkest_after"] < most:
            return Verdict(False, "the darkest rays fit no better")
    if "held_out_rival" in evidence and not _as_good(evidence):
        return Verdict(False, f"it explains the rays no better than {rival}")
    return Verdict(True, "")


def _as_good(evidence: Mapping[str, float]) -> bool:
    """Whether it explains the rays as well as the rival, and the darkest better, or all of them far better."""
    held_out, rival = evidence["held_out_after"], evidence["held_out_rival"]
    darkest, of_rival, tell = evidence["darkest_after"], evidence["darkest_rival"], _darkest_tell(evidence)
    if _far_better(evidence, "rival"):
        return darkest <= of_rival or not tell
    return tell and held_out < (1 + MARGIN) * rival and darkest < (1 - _DARKER) * of_rival


def _darkest_tell(evidence: Mapping[str, float]) -> bool:
    """Whether scatter would show in the darkest rays beyond their noise."""
    return evidence.get("darkest_share", 1.0) * math.sqrt(evidence.get("darkest_rays", math.inf)) >= _SIGNAL


def _far_better(evidence: Mapping[str, float], than: str) -> bool:
    return evidence["held_out_after"] < _FAR_BETTER * evidence[f"held_out_{than}"]


def more_likely(scatter: Mapping[str, float], beam: Mapping[str, float]) -> str:
    """What explains the rays where both do, better than neither: "scatter" or "beam".

    Both cannot be left out then: the rays beside the object have more light than the open field. A brighter beam is
    the smaller change, and takes nothing away from dark rays. Yet it is as much brighter everywhere: scatter that
    varies, and explains more, is no beam. Without metal that tells more than the darkest rays, which have much light.
    Nor is what explains all rays far better: under scatter metal is denser, and a short fit does not get there.

    Parameters
    ----------
    scatter, beam : mapping of str to float
        See `light_gate`; ``of_light`` of the scatter is how much it varies, 0 for a constant.
    """
    held_out = scatter["held_out_after"] / beam["held_out_after"]
    darker = _darkest_tell(scatter) and scatter["darkest_after"] < beam["darkest_after"]
    varies = scatter.get("of_light", 0.0) != 0
    tells = darker or varies or held_out < _FAR_BETTER
    return "scatter" if held_out < 1 - MARGIN and tells else "beam"

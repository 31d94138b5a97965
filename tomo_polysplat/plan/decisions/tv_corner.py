"""How much of what varies in a volume is smoothed: noise in full, texture hardly."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import torch

from tomo_polysplat.model.seed_samples import widened
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.plan.decision import Decision, Known, is_number
from tomo_polysplat.plan.decisions.soft_reference import SoftReference
from tomo_polysplat.plan.decisions.support_level import SupportLevel
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.plan import adapted_to
from tomo_polysplat.settings import Settings

__all__ = ["TvCorner", "bodies", "corners_for", "share_alike", "tv_corners"]

# What counts as the object where its smoothness is judged, in soft references, and how many voxels from metal.
_BODY, _BESIDE_METAL = 0.3, 3
# Largest difference of neighbouring voxels that counts in full, in soft references: where nothing tells texture, and
# where all is texture. That is told by the agreement of two halves of the views on their signs: from the first value to
# the second, of soft matter and of dense matter, whose surfaces alone agree by as much. Chosen on the six scenes of the
# bench and on slices of other simulators (broccoli, 256^3, with 0.1, 0.03 and 0.01: 33.5, 37.1 and 39.8 dB; pepper,
# 64^3, with 0.02 and 0.01: 31.8 and 31.4; a hip with 0.1 and 0.03: 32.0 and 31.4).
_SMOOTH, _TEXTURED = 0.1, 0.015
_OF_SOFT, _OF_DENSE = (0.0, 0.3), (0.2, 0.5)
# In a small volume nearly all voxels lie at edges, of which both halves tell, and what varies within a voxel is left to
# smoothing: the agreement counts from the first cube root of the number of voxels on, and in full from the second (with
# 0.1 and what agreement alone would say, pancreas 40^3: 37.6 and 36.0 dB; pins 69 x 69 x 16: 33.2 and 30.9; teeth 64^3:
# 39.3 and 40.5).
_SMALL, _LARGE = 40, 64
# A large volume of more than one soft matter is smoothed like this share of texture at least, whatever its halves say:
# from the first number of voxels along its shortest edge on, and in full from the second (256^3 voxels, with 0.1 and
# 0.03: teeth 44.9 and 45.6 dB, with a tenth of the photons 41.3 and 42.6; lung 40.4 and 40.6, 39.2 and 40.1; but pins,
# one matter, 36.7 and 35.8).
_AT_LEAST, _THICK = 0.63, (64, 128)
# Soft matter counts as textured where up to the first share of its inside is this close to its median, and as
# homogeneous from the second on (pins of 48 to 96 voxels along an edge 0.73 to 0.76, the other scenes 0.00 to 0.62),
# told by so many voxels.
_ALIKE, _ONE_MATTER, _FEWEST = 0.05, (0.6, 0.75), 1000
# The least share of those differences that light matter is smoothed by: what looks lighter is walls too thin to show
# how dense they are.
_LIGHTEST = 0.3


def tv_corners(
    relative: torch.Tensor,
    settings: Settings,
    agreement: Callable[[Sequence[torch.Tensor]], list[float | None]],
    lightness: float = 1.0,
) -> tuple[tuple[float, float], str]:
    """Where differences begin to count by their logarithm, sooner the more of them are the object's own, and why.

    Parameters
    ----------
    relative : (nz, ny, nx) tensor
        The start, in soft references.
    settings : Settings
    agreement : callable
        What `start.agreement.halves_agree` finds of the bodies it is given; called where that matters.
    lightness : float
        Attenuation of the main matter, at most 1: differences within foam or wood are smaller than in water.

    Returns
    -------
    corners : pair of float
        Differences of neighbouring voxels that count in full, of soft and of dense matter, in soft references.
    why : str
    """
    if settings.tv_corner or not settings.tv_weight:
        corner = settings.tv_corner or 0.0
        return (corner, corner), "asked for"
    light = max(lightness, _LIGHTEST)
    if math.prod(relative.shape) <= _SMALL**3:
        words = f"differences up to {light * _SMOOTH:.2g} soft references are smoothed"
        return (light * _SMOOTH, _SMOOTH), f"{words}: in so few voxels edges cannot be told from texture"
    matter = bodies(relative, settings)
    found = agreement(matter)
    alike = share_alike(relative, matter[0])
    of_soft, of_dense = corners_for(found, relative.shape, alike)
    corners = (light * of_soft, of_dense)
    words = f"differences up to {corners[0]:.2g} soft references are smoothed, in dense matter up to {corners[1]:.2g}"
    told = [
        f"of {kind} by {share:+.0%}"
        for kind, share in zip(("soft matter", "dense matter"), found)
        if share is not None
    ]
    why = (
        f"two halves of the views agree on the signs {', '.join(told)}, and {alike:.0%} of the soft matter is alike"
        if told
        else "halves of the views do not tell"
    )
    return corners, f"{words}: {why}"


def share_alike(relative: torch.Tensor, body: torch.Tensor) -> float:
    """Share of a body's voxels, away from its surface, whose value is close to their median; 0 of too few."""
    values = relative[~widened(~body, 1)]
    if len(values) < _FEWEST:
        return 0.0
    return float(((values / values.median() - 1).abs() < _ALIKE).float().mean())


def bodies(relative: torch.Tensor, settings: Settings) -> list[torch.Tensor]:
    """Voxels of soft and of bone-like matter in a volume in soft references, none of them near metal."""
    dense, away = relative > settings.bone_level, ~widened(relative > settings.metal_level, _BESIDE_METAL)
    return [(relative > _BODY) & ~dense & away, dense & away]


def corners_for(agreement: Sequence[float | None], shape: Sequence[int], alike: float) -> tuple[float, float]:
    """Differences of neighbouring voxels that count in full, of soft and of dense matter.

    ``agreement`` is what `start.agreement.halves_agree` found of `bodies`, ``shape`` that of the volume, and ``alike``
    the `share_alike` of soft matter: what two halves agree on in a homogeneous body is its edges, and streaks of metal.
    """
    fine = _ramp(math.prod(shape) ** (1 / 3), _SMALL, _LARGE)
    soft, dense = agreement
    of_soft = 0.0
    if soft is not None:
        least = _AT_LEAST * _ramp(min(shape), *_THICK)
        of_soft = max(_ramp(soft, *_OF_SOFT), least) * (1 - _ramp(alike, *_ONE_MATTER))
    of_dense = of_soft if dense is None else _ramp(dense, *_OF_DENSE)
    if min(shape) == 1:
        # Few rays a voxel: noise within dense matter is far above any texture that its surfaces seem to tell.
        of_dense = 0.0
    ratio = _TEXTURED / _SMOOTH
    return _SMOOTH * ratio ** (fine * of_soft), _SMOOTH * ratio ** (fine * of_dense)


def _untold(bodies: Sequence[torch.Tensor]) -> list[float | None]:
    """No agreement, where there is no time for the volumes that tell it."""
    return [None] * len(bodies)


def _ramp(value: float, start: float, end: float) -> float:
    """From 0 to 1."""
    return min(max((value - start) / (end - start), 0.0), 1.0)


class TvCorner(Decision):
    """Up to which difference of neighbouring voxels is the volume smoothed in full?

    Two numbers in soft references: of soft and of dense matter.
    """

    name = "tv_corner"
    needs = (SoftReference, SupportLevel)

    def given(self, settings: Settings) -> Any | None:
        """One number in the settings stands for both; see `tv_corners`."""
        return None

    def valid(self, value: Any) -> bool:
        """Two numbers."""
        return isinstance(value, list) and len(value) == 2 and all(is_number(corner, 0.0) for corner in value)

    def ask(self, known: Known, lab: Lab) -> Answer:
        """By what two halves of the views agree on."""
        light = known.answer(SupportLevel).evidence["lightness"]
        settings = adapted_to(known[SoftReference], lab.settings)
        # Two more volumes take as long as the start did.
        agreement = _untold if lab.late else lab.problem.agreement
        corners, why = tv_corners(lab.relative, settings, agreement, light)
        given = bool(lab.settings.tv_corner) or not lab.settings.tv_weight
        return Answer(list(corners), why, Status.GIVEN if given else Status.ASKED)

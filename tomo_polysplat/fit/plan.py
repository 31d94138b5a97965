"""What a scene needs, decided from the data before the fit, with the reasons.

Densities and attenuations inside a fit are in units of the scan's *soft reference*: water of 1 g/cm3 for a
polychromatic model, and the level that holds the middle of the object's mass for a monochromatic one. So the
same settings serve a scan in any unit.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import torch

from tomo_polysplat.physics.detector_blur import describe_blur
from tomo_polysplat.settings import Settings
from tomo_polysplat.start.levels import MAIN_SHARE, main_level, mass_level

if TYPE_CHECKING:
    from tomo_polysplat.fit.problem import Problem

__all__ = ["Plan", "bodies", "corners_for", "make_plan", "share_alike", "soft_reference"]

logger = logging.getLogger(__name__)

# Seeds along the longest edge: a ray through few large voxels tells what is inside them, and an object's outline
# in a handful of Gaussians would leave its mass wrong.
_FEWEST_SEEDS = 12
# Fewer steps than this leave edges blurred; more of one view each are noisier than fewer of several. A GPU, whose
# steps cost little, makes more of them (256^3: 40.1 dB with 4 views a step, 39.0 with 8, for 1.6 times the time).
# The few rays of a planar view do with fewer steps (five fan-beam slices: 38.0 dB with 4 views a step, 38.3 with 8).
_STEPS, _MOST_VIEWS, _MOST_VIEWS_PLANAR = 300, {"cpu": 8, "cuda": 4}, 8
# Voxels along an edge of the box that is smoothed. What a box seldom meets is smoothed by leaps, which upset the
# optimiser's sense of scale (teeth, 128^3 voxels: 39.1, 39.7 and 40.2 dB with 32, 64 and 128).
_TV_BOX, _TV_BOX_PLANAR = {"cpu": 48, "cuda": 128}, 256
# What counts as the object where its smoothness is judged, in soft references, and how many voxels from metal.
_BODY, _BESIDE_METAL = 0.3, 3
# Differences of neighbouring voxels count in full up to so many soft references where nothing tells texture, and where
# all is texture. That is told by the agreement of two halves of the views on their signs: from the first value to the
# second, of soft matter and of dense matter, whose surfaces alone agree by as much. Chosen on the six scenes of the
# bench and on slices of other simulators (broccoli, 256^3, with 0.1, 0.03 and 0.01: 33.5, 37.1 and 39.8 dB; pepper,
# 64^3, with 0.02 and 0.01: 31.8 and 31.4; a hip with 0.1 and 0.03: 32.0 and 31.4).
_SMOOTH, _TEXTURED = 0.1, 0.015
_OF_SOFT, _OF_DENSE = (0.0, 0.3), (0.2, 0.5)
# In a small volume nearly all voxels lie at edges, of which both halves tell, and what varies within a voxel is left to
# smoothing: the agreement counts from the first cube root of the number of voxels on, and in full from the second (with
# 0.1 and what agreement alone would say, pancreas 40^3: 37.6 and 36.0 dB; pins 69 x 69 x 16: 33.2 and 30.9; teeth 64^3:
# 39.3 and 40.5).
_SMALL, _LARGE = 40, 64
# Soft matter counts as textured where up to the first share of its inside is this close to its median, and as
# homogeneous from the second on (pins of 48 to 96 voxels along an edge 0.73 to 0.76, the other scenes 0.00 to 0.62),
# told by so many voxels.
_ALIKE, _ONE_MATTER, _FEWEST = 0.05, (0.6, 0.75), 1000
# Gaussians that a laptop and a GPU fit in a time people wait for.
_MOST_GAUSSIANS = {"cpu": 60_000, "cuda": 400_000}
# Objects of solid metal are so many times as dense as water at most (rods of silver: 180, of gold: 280): only beyond
# is the unit of length in doubt.
_DENSEST = 600.0


@dataclass
class Plan:
    """The decisions.

    Attributes
    ----------
    reference : float
        Soft reference: g/cm3, or 1/unit when monochromatic.
    spacing : float
        Distance of the seeds in voxels.
    finer : float
        Share of the Gaussians that is seeded twice as finely as the rest; see ``model.seed``.
    views_per_step : int
    tv_box : int
        Edge in voxels of the random box whose total variation a step takes.
    tv_corners : pair of float
        Difference of neighbouring voxels, in soft references, up to which it counts in full: of soft matter, and where
        one of the two is bone-like or denser.
    curves : int
        Material curves of the model: three, or the first alone, as for a monochromatic one.
    blurred : bool
        Whether rays are seen through the detector's blur; see ``physics.detector_blur``.
    reasons : dict
        Decision by decision, what was chosen and why; it becomes ``Result.plan``.
    """

    reference: float
    spacing: float
    finer: float
    views_per_step: int
    tv_box: int
    tv_corners: tuple[float, float]
    curves: int
    blurred: bool
    reasons: dict[str, Any] = field(default_factory=dict)


def make_plan(start: np.ndarray | torch.Tensor, problem: Problem, settings: Settings, device: str) -> Plan:
    """Decide from the start volume and the geometry.

    Parameters
    ----------
    start : (nz, ny, nx) array or tensor
        First reconstruction in the solver's units (``Problem.start_volume``).
    problem : Problem
    settings : Settings
        Zero stands for "decide", anything else is taken as it is.
    device : "cpu" or "cuda"
    """
    reference, level = soft_reference(start, problem)
    why = _why_reference(reference, level, problem.polychromatic)
    support = int((start > settings.support_level * reference * problem.depth).sum())
    spacing, finer, because = _seed_spacing(support, problem, settings, device)
    most = _MOST_VIEWS_PLANAR if problem.planar else _MOST_VIEWS[device]
    views, reason = _views_per_step(problem.geometry.views, settings, most)
    box = settings.tv_box or (_TV_BOX_PLANAR if problem.planar else _TV_BOX[device])
    soft = reference * problem.depth
    curves, needed = _curves(start, soft, problem.polychromatic, settings)
    blurred, told = _blurred(start, soft, settings)
    corners, texture = _tv_corners(start, soft, problem, settings)
    plan = Plan(reference, spacing, finer, views, box, corners, curves, blurred)
    unit = "g/cm3" if problem.polychromatic else "per unit of length"
    plan.reasons = {
        "model": "polychromatic: a spectrum was given"
        if problem.polychromatic
        else "monochromatic: no spectrum was given, or one of a single energy",
        "curves": f"{curves}: {needed}",
        "dimensions": "2D Gaussians: one row and one slice in one plane"
        if problem.planar
        else "3D Gaussians: several rows or slices, or rays that leave the plane",
        "soft_reference": f"{reference:.4g} {unit}: {why}",
        "support": f"{support} of {math.prod(start.shape)} voxels"
        f" hold more than {settings.support_level:g} soft references",
        "seed_spacing_voxels": f"{spacing:.2f}: {because}",
        "views_per_step": f"{views} of {problem.geometry.views}: {reason}",
        "smoothed_box": _smoothed(box, start, settings),
        "texture": texture,
        "detector_blur": told,
        "passes": f"{settings.passes:g} over the views at most, fewer where {settings.held_out:.1%} of the rays, held"
        f" out of the fit, have not improved for {settings.patience}",
    }
    return plan


def soft_reference(start: np.ndarray | torch.Tensor, problem: Problem) -> tuple[float, float]:
    """Soft reference in g/cm3, or per unit of length for one energy, and the level of the object's main matter."""
    if not problem.polychromatic:
        level = main_level(start) / problem.depth
        return level or 1.0, level
    level = mass_level(start) / problem.depth
    factor = 1000.0 ** round(math.log10(level) / 3) if level > 0 else 1.0
    return (1.0 if 1 < level <= _DENSEST else factor), level


def _why_reference(reference: float, level: float, polychromatic: bool) -> str:
    if not polychromatic:
        return f"{MAIN_SHARE:.0%} of the start's mass lies below it, metal not counted"
    if reference == 1:
        return f"water: half of the object's mass is at most {level:.3g} times as dense"
    logger.warning(
        "The object is as dense as %.3g g/cm3 of water: the unit of length looks wrong by a factor of %g.",
        level,
        reference,
    )
    return (
        f"water, with lengths off by a factor of {reference:g}: the object looks {level:.3g} times as dense"
    )


def _curves(
    start: np.ndarray | torch.Tensor, soft: float, polychromatic: bool, settings: Settings
) -> tuple[int, str]:
    """How many material curves, for a start whose soft reference is ``soft``."""
    if not polychromatic:
        return 1, "there is one energy, and no material to tell by it"
    if settings.curves:
        return settings.curves, "asked for"
    if settings.soft_u:
        return 3, "soft matter has a material number other than 0"
    dense = int((start > settings.bone_level * soft).sum())
    if dense:
        return 3, f"{dense} voxels of the start are denser than {settings.bone_level:g} soft references"
    largest = float(start.max()) / soft if soft else 0.0
    return 1, (
        f"the densest voxel of the start has {largest:.2g} soft references, so that no material number would be free"
    )


def _tv_corners(
    start: np.ndarray | torch.Tensor, soft: float, problem: Problem, settings: Settings
) -> tuple[tuple[float, float], str]:
    """Where differences begin to count by their logarithm: sooner the more of them are the object's own."""
    if settings.tv_corner or not settings.tv_weight:
        return (settings.tv_corner, settings.tv_corner), "asked for"
    voxels = math.prod(start.shape)
    if voxels <= _SMALL**3:
        words = f"differences up to {_SMOOTH:g} soft references are smoothed"
        return (_SMOOTH, _SMOOTH), f"{words}: in so few voxels edges cannot be told from texture"
    relative = torch.as_tensor(start) / soft if soft else torch.as_tensor(start)
    matter = bodies(relative, settings)
    found = problem.agreement(matter)
    alike = share_alike(relative, matter[0])
    corners = corners_for(found, voxels, alike)
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
    values = relative[~_widened(~body, 1)]
    if len(values) < _FEWEST:
        return 0.0
    return float(((values / values.median() - 1).abs() < _ALIKE).float().mean())


def bodies(relative: torch.Tensor, settings: Settings) -> list[torch.Tensor]:
    """Voxels of soft and of bone-like matter in a volume in soft references, none of them near metal."""
    dense, away = relative > settings.bone_level, ~_widened(relative > settings.metal_level, _BESIDE_METAL)
    return [(relative > _BODY) & ~dense & away, dense & away]


def _widened(mask: torch.Tensor, reach: int) -> torch.Tensor:
    """The voxels of a mask and those up to ``reach`` from them along every axis."""
    wide = mask.to(torch.float32)[None]
    for axis in range(3):
        window, margin = [1, 1, 1], [0, 0, 0]
        window[axis], margin[axis] = 2 * reach + 1, reach
        wide = torch.nn.functional.max_pool3d(wide, window, 1, margin)
    return wide[0] > 0


def corners_for(agreement: Sequence[float | None], voxels: int, alike: float) -> tuple[float, float]:
    """Differences of neighbouring voxels that count in full, of soft and of dense matter.

    ``agreement`` is what `start.agreement.halves_agree` found of `bodies`, ``voxels`` the number of them all, and
    ``alike`` the `share_alike` of soft matter: what two halves agree on in a homogeneous body is its edges, and streaks
    of metal.
    """
    fine = _ramp(voxels ** (1 / 3), _SMALL, _LARGE)
    soft, dense = agreement
    of_soft = 0.0 if soft is None else _ramp(soft, *_OF_SOFT) * (1 - _ramp(alike, *_ONE_MATTER))
    of_dense = of_soft if dense is None else _ramp(dense, *_OF_DENSE)
    ratio = _TEXTURED / _SMOOTH
    return _SMOOTH * ratio ** (fine * of_soft), _SMOOTH * ratio ** (fine * of_dense)


def _ramp(value: float, start: float, end: float) -> float:
    """From 0 to 1."""
    return min(max((value - start) / (end - start), 0.0), 1.0)


def _blurred(start: np.ndarray | torch.Tensor, soft: float, settings: Settings) -> tuple[bool, str]:
    """Whether the detector's blur is modelled: where it is to be fitted, metal must show that edges are sharp."""
    if not settings.learning_rate_blur:
        return settings.blur > 0, describe_blur(settings.blur, fitted=False)
    if bool((start > settings.metal_level * soft).any()):
        return (
            True,
            f"fitted, from a variance of {settings.blur:g} squared pixels on: metal has edges that hold it",
        )
    return False, "none: without metal, a smooth object and a detector that blurs look alike"


def _seed_spacing(
    support: int, problem: Problem, settings: Settings, device: str
) -> tuple[float, float, str]:
    """Distance of the seeds in voxels (the shortest edge), for a support of as many voxels, and the finer share."""
    if settings.seed_spacing:
        return settings.seed_spacing, 0.0, "asked for"
    dims = 2 if problem.planar else 3
    most = settings.max_gaussians or _MOST_GAUSSIANS[device]
    finest, because = _finest_spacing(problem)
    cells = support * float(np.prod(problem.grid.voxel_size[:dims] / problem.voxel))
    crowded = (cells / most) ** (1 / dims)
    if crowded <= finest:
        return finest, 0.0, because
    because = f"at most {most} Gaussians over {support} voxels of support"
    finer = settings.finer_seeds
    return crowded, finer, f"{because}, {finer:.0%} of them closer where the start varies"


def _finest_spacing(problem: Problem) -> tuple[float, str]:
    """Seeds no closer than the detector can tell apart, and than the voxels can show, unless these are few."""
    width, height = problem.geometry.pixel_size_at(problem.grid.centre)
    pixel = (width if problem.planar else math.sqrt(width * height)) / problem.voxel
    edge = float((problem.grid.extent / problem.voxel)[: 2 if problem.planar else 3].max())
    if pixel > 1.0:
        return 1.3 * pixel, "1.3 detector pixels at the object"
    few = max(1.3 * pixel, edge / _FEWEST_SEEDS)
    if few < 1.3 - 1e-6:
        return few, f"a volume of few voxels: {_FEWEST_SEEDS} seeds along it, or 1.3 detector pixels"
    return 1.3, "1.3 voxels"


def _smoothed(box: int, start: np.ndarray | torch.Tensor, settings: Settings) -> str:
    whole = box >= max(start.shape)
    where = "all of the volume" if whole else f"a box of {box} voxels an edge, elsewhere in each step"
    return f"{where}: {'asked for' if settings.tv_box else 'what a step has time for'}"


def _views_per_step(views: int, settings: Settings, most: int) -> tuple[int, str]:
    """As many as leave enough steps."""
    if settings.views_per_step:
        return min(views, settings.views_per_step), "asked for"
    steps = settings.passes * views / _STEPS
    together = max(1, min(views, most, round(steps)))
    return together, f"for about {_STEPS} steps, and at most {most} views in each"

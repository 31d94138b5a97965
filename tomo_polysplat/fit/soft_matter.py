"""The soft matter's material number, from the flatness of what is homogeneous.

A little cupping and a little hardening look alike to the rays, so a free number would drift (`fit.step`). But where
most of an object is one matter, as in a phantom or a part made of plastic, there is no cupping: its attenuation does
not depend on how deep it lies. A number too high makes the inside look denser than the rim, one too low lighter.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import torch
from scipy import ndimage

from tomo_polysplat.fit.scene import FitScene
from tomo_polysplat.kernels.voxelise.box import VoxelBox
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.settings import Settings

__all__ = ["cupping", "describe_soft", "flatten"]

# Points along an edge at which the volume is looked at.
_POINTS = 40
# Parts of a run in which the number moves: the first passes are not flat for other reasons, the last ones settle.
_FROM, _UNTIL = 0.2, 0.8
# In distances of the points: how far from air and from denser matter the soft one is taken to be itself, and how far
# from metal what is dense may still be the blur of that (with 2.5 a tooth's root passed for it, beside a post).
_RIM, _BESIDE, _HALO = 1.5, 2.5, 1.5
# In soft references: below it there is air. In units of the soft matter: air lies below the first, denser matter above
# the second.
_LEAST = 0.3
_AIR, _DENSE = 0.5, 1.6
# Of the points of the object, the share that may be denser without being metal or beside it: bone hardens the beam as
# well, and what is left of that looks like cupping.
_OTHER = 0.005
# Of the points inside, the share that must be this close to their median for the matter to be one, and how many there
# must be, in how many layers of equal depth.
_ONE, _CLOSE, _FEWEST, _LAYERS = 0.8, 0.1, 200, 6
# The number leaves where it began only if the first slope is this many standard errors: where the deepest layer alone
# is darker, between screws, that is no cupping. Later slopes bring it back as well.
_CERTAIN = 3.0
# Farthest from its start that the number goes: plastics and oil lie this far below water, and solids farther from what
# their attenuation says.
_REACH, _REACH_OF_SOLIDS = 0.1, 0.2
# Digits to which a change is rounded: the sums behind it repeat only to rounding on a GPU, and a fit that starts to
# differ ends a percent apart.
_DIGITS = 4
# A number closer than this to where it began has not left it.
_ROUNDING = 1e-6
# Own numbers less than this above its number belong to soft matter.
_SOFT = 0.2


@torch.no_grad()
def flatten(gaussians: Gaussians, scene: FitScene, settings: Settings, share: float) -> None:
    """Move the soft matter's number, and those of soft Gaussians near metal, against the cupping there is.

    Where there is none to be told, they move back to where they began.

    Parameters
    ----------
    gaussians : Gaussians
        Changed in place.
    scene : FitScene
    settings : Settings
        ``soft_gain`` times the cupping, and times the share that is left, is the change.
    share : float
        Of the run that is done.
    """
    if scene.reference_curve is None or not settings.soft_gain or not _FROM <= share <= _UNTIL:
        return
    box = _coarse(scene.box)
    sampling = box.spacing[::-1] / box.spacing.max()
    volume = scene.attenuation(gaussians, box).cpu().numpy()
    found = cupping(volume, settings.bone_level, settings.metal_level, sampling)
    number = gaussians.shared_material[0]
    away = settings.soft_u - float(number)
    if found is not None and abs(away) < _ROUNDING and abs(found[0]) < _CERTAIN * found[1]:
        return
    # Less and less, as of any estimate that is averaged over a noisy run (Robbins and Monro 1951).
    gain = settings.soft_gain * (1 - share)
    change = round(gain * (away if found is None else -found[0]), _DIGITS)
    reach = _REACH if settings.soft_u < _SOFT else _REACH_OF_SOLIDS
    least, most = max(scene.least_u, settings.soft_u - reach), min(settings.soft_u + reach, 1.0)
    moved = number.add(change).clamp(least, most)
    own = gaussians.own_material
    own.copy_(
        torch.where(own < settings.soft_u + _SOFT, own + (moved - number), own).clamp(scene.least_u, 1.0)
    )
    number.copy_(moved)


def cupping(
    attenuation: np.ndarray, bone_level: float, metal_level: float, sampling: np.ndarray | None = None
) -> tuple[float, float] | None:
    """By what share homogeneous matter is brighter at its deepest than at its rim.

    Parameters
    ----------
    attenuation : (nz, ny, nx) array
        In soft references.
    bone_level, metal_level : float
        Levels above which matter is not soft, and above which it is metal, whose surroundings say nothing.
    sampling : (3,) array, optional
        Distances of the points along z, y and x, in units of the longest; 1 by default.

    Returns
    -------
    (float, float) or None
        The share and its standard error; None where the object is not mostly one matter, is too small to tell, or
        nowhere ends in air.
    """
    volume = attenuation[0] if attenuation.shape[0] == 1 else attenuation
    apart = (np.ones(3) if sampling is None else sampling)[-volume.ndim :]
    body = volume[(volume > _LEAST) & (volume < metal_level)]
    level = float(np.median(body)) if len(body) >= _FEWEST else 0.0
    if not 0 < level <= bone_level:
        return None
    dense, away = volume > _DENSE * level, np.full(volume.shape, np.inf)
    if (volume >= metal_level).any():
        away = ndimage.distance_transform_edt(volume < metal_level, sampling=apart)
    if np.count_nonzero(dense & (away > _HALO)) > _OTHER * len(body):
        return None
    matter = volume > _AIR * level
    if matter.all():
        return None
    depth = _depth(matter, apart)
    inside = depth > _RIM
    if dense.any():
        inside &= ndimage.distance_transform_edt(~dense, sampling=apart) > _BESIDE
    if np.count_nonzero(inside) < _FEWEST or depth[inside].max() <= 2 * _RIM:
        return None
    values, depth = volume[inside] / np.median(volume[inside]), depth[inside]
    close = np.abs(values - 1) < _CLOSE
    return _slope(values[close], depth[close] / depth.max()) if close.mean() >= _ONE else None


def _depth(matter: np.ndarray, sampling: np.ndarray) -> np.ndarray:
    """Distance from air; beyond the border the object goes on."""
    wide = ndimage.distance_transform_edt(np.pad(matter, 1, mode="edge"), sampling=sampling)
    return wide[(slice(1, -1),) * matter.ndim]


def _slope(values: np.ndarray, depth: np.ndarray) -> tuple[float, float]:
    """Slope of the medians of layers of equal depth, which inclusions and what is left of streaks do not pull.

    With the standard error that the medians' distances from a line leave it.
    """
    layers = np.array_split(np.argsort(depth, kind="stable"), _LAYERS)
    heights = [float(np.median(values[layer])) for layer in layers]
    line, covariance = np.polyfit([float(depth[layer].mean()) for layer in layers], heights, 1, cov=True)
    return float(line[0]), math.sqrt(covariance[0, 0])


def describe_soft(number: float, begun_at: float, gain: float) -> str:
    """What a reconstruction took for the soft matter's material number, in words."""
    if not gain:
        return f"{number:.3f}, held as asked for"
    if abs(number - begun_at) < 1e-6:
        why = "the object is not one homogeneous matter beside its metal, or the run was too short to tell"
        return f"{number:.3f}, held: {why}"
    return f"{number:.3f}, by which the object's one matter is as dense inside as at its rim"


def _coarse(box: VoxelBox) -> VoxelBox:
    """The volume at no more than so many points an axis, each a voxel's centre."""
    step = [-(-n // _POINTS) for n in box.shape]
    nz, ny, nx = (-(-n // k) for n, k in zip(box.shape, step))
    return replace(box, spacing=box.spacing * np.array(step[::-1]), shape=(nz, ny, nx))

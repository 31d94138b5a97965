"""Every tunable of a reconstruction, its unit and its default, and the quality presets."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from typing import Any

from tomo_polysplat.checks import did_you_mean, fail, require_choice, require_number
from tomo_polysplat.free_memory import bytes_of

__all__ = ["PRESETS", "Settings", "make_settings"]

_MOVED = ("position", "scale", "rotation", "attenuation", "material", "shared", "blur")
# Of those that are not any number from 0 on; the docs print them. Material numbers go a little below the first curve.
_RANGES: dict[str, dict[str, Any]] = {
    **dict.fromkeys(("soft_u", "bone_u", "metal_u"), {"at_least": -0.1, "at_most": 1.0}),
    "light_u": {"at_least": -0.1, "at_most": 0.1},
    # Far beyond these the mean of a volume fell to a third or to 0, or rose to ten times and more.
    "seed_width": {"at_least": 0.3, "at_most": 100.0},
    "largest_scale": {"at_least": 0.5, "at_most": 100.0},
    "support_level": {"at_least": 0.0, "at_most": 1.0},
    "seed_spacing": {"above": 0.0, "at_most": 32.0},
    "closer_seeds": {"at_least": 0.0, "at_most": 8.0},
    "smallest_scale": {"above": 0.0, "at_most": 3.0},
    "final_rate": {"above": 0.0, "at_most": 1.0},
    **dict.fromkeys((f"learning_rate_{of}" for of in _MOVED), {"at_least": 0.0, "at_most": 100.0}),
    **dict.fromkeys(("model_error", "huber_corner"), {"above": 0.0}),
    **dict.fromkeys(("passes", "metal_rim"), {"above": 0.0}),
    **dict.fromkeys(("tv_factor", "tv_corner", "growth"), {"above": 0.0}),
    **dict.fromkeys(
        ("views_per_step", "max_gaussians", "pixel_rays", "tv_every", "patience", "spectral_nodes"),
        {"at_least": 1},
    ),
    "blur": {"at_least": 0.0, "at_most": 0.6},
    "held_out": {"at_least": 0.0, "at_most": 0.5},
    "finer_seeds": {"at_least": 0.0, "at_most": 0.9},
    "metal_tail": {"at_least": 0.0, "at_most": 0.8},
}
_CHOICES = {
    "loss": ("huber", "weighted-l1", "l1"),
    "edges": ("sharp", "blurred"),
    "light": ("soft", "fat"),
    "density_check": ("refuse", "warn"),
    "kernel": ("auto", "triton", "numba", "reference"),
}
_SWITCHES = ("gains", "drift", "beam")


@dataclass(frozen=True)
class Settings:
    """Tunables of the solver.

    None leaves a setting to the plan, which decides it from the data (docs/plan.md). Lengths are in voxels, or in units
    of the seeds' mean distance, as said; attenuation and density are in units of the scan's soft reference (water, for
    most objects).
    """

    # The run.
    passes: float | None = None
    """How often every view is used. Held-out rays or a time budget may end the run before."""
    views_per_step: int | None = None
    """Views whose gradients make one step of the optimiser."""
    held_out: float = 0.01
    """Share of the rays that are not fitted. They tell when the fit stops improving."""
    patience: int | None = None
    """Number of passes without improvement of the held-out rays that ends the run. None: four tenths of the passes, and
    at least 4."""
    kernel: str = "auto"
    """"auto", "triton", "numba" or "reference"."""
    memory: float | str | None = None
    """What a run may hold on the device that it fits on, in bytes or as text such as "12 GB"; None: all that is free.
    The plan stays below it: fewer Gaussians, start and projections on the host, smaller slabs. Nothing is enforced."""

    density_check: str = "refuse"
    """An object of a density that no matter has, as in a wrong unit of length: "refuse" it, or "warn" and go on."""

    # Seeds.
    max_gaussians: int | None = None
    """About how many Gaussians at most. Metal, which is seeded more closely, is not counted."""
    seed_spacing: float | None = None
    """Distance of the seeds in voxels."""
    closer_seeds: float | None = None
    """Distance in voxels of seeds that are thin across sharp edges; 0: no closer than the others."""
    growth: float | None = None
    """Largest number of Gaussians at the end, as a multiple of the number of seeds. Gaussians split; 1: none does."""
    edges: str | None = None
    """"sharp": all seeds are thin across edges. "blurred": none is thinner than the detector could tell apart."""
    support_level: float = 0.1
    """Where the start is below this share of the soft reference, there are no seeds. For foam and down, whose main
    matter is lighter than 0.15 of the reference, it is lowered in proportion."""
    finer_seeds: float = 0.5
    """Where Gaussians are fewer than the detector could tell apart, this share of them lies twice as close."""
    seed_width: float = 0.6
    """Standard deviation of a seed in units of the spacing."""
    seed_edge: float = 0.2
    """Variation of the start over a spacing, in soft references, that makes a seed half as thick across the edge, and
    wider along it, where Gaussians are fewer than the detector could tell apart; 0: all seeds are round."""
    smallest_scale: float | None = None
    """Smallest standard deviation in voxels, or in seed spacings where seeds are closer than voxels."""
    largest_scale: float = 8.0
    """Largest standard deviation in seed spacings."""
    relocated: float = 0.03
    """Largest share of the Gaussians that, once a pass, moves from where it holds nothing to where it is wanted."""
    relocate_until: float = 0.5
    """Share of the run after which no Gaussian is moved: the new ones need time to settle."""
    surroundings: float = 0.5
    """Where the object reaches beyond both the detector and the volume, or is longer than that of a cone beam, the
    volume is larger during the fit, on every side by this share of its edge at most; 0: never."""

    # Smoothing.
    tv_weight: float = 0.04
    """Weight of the total variation per voxel, in soft references."""
    tv_factor: float | None = None
    """Factor of ``tv_weight``."""
    tv_corner: float | None = None
    """Difference of neighbouring voxels, in soft references, up to which it counts in full. Larger ones count by their
    logarithm, so that edges and texture stay; with 1000 all count in full."""
    tv_every: int | None = None
    """Every how many steps the total variation is taken. It is then multiplied by that number."""

    # Materials.
    curves: int | None = None
    """Material curves under a spectrum: 1 for the soft one alone, or 3."""
    bone_level: float = 2.2
    """Level in soft references above which matter of the start is bone-like. Material numbers are free near it."""
    metal_level: float = 6.0
    """Level in soft references above which matter is metal. In an object of one solid it is at least three times the
    density of that solid."""
    metal_rim: float | None = None
    """Level down to which what is connected to metal belongs to it; None: ``metal_level`` itself."""
    metal_tail: float = 0.5
    """A voxel that nowhere reaches this share of the metal around it holds a tail, which goes back to that metal."""
    agent: dict[str, float] | None = None
    """Settings that the seeds start from where a contrast agent or a metal was named; {}: none are changed."""
    light: str | None = None
    """What matter of 0.65 to 0.95 soft references is: "soft" matter of less density, or "fat", which hardens the beam
    less."""
    soft_u: float = 0.0
    """Material number of soft matter that the fit starts from. Near dense matter it is free."""
    soft_gain: float = 1.0
    """Where the soft matter is one, its number moves by this times the cupping once a pass; 0 holds it."""
    light_u: float = -0.056
    """Material number of fat, less that of soft matter; that of adipose tissue by default."""
    bone_u: float = 0.3
    """Material number that matter of four soft references starts from: that of bone (``model/bone_numbers.py``)."""
    metal_u: float = 0.8
    """Material number that metal starts from. At this default, under the default curves, its attenuation tells the
    number after the first pass (``fit/metal_numbers.py``)."""
    free_radius: float = 6.0
    """Gaussians have a material number of their own within this many voxels of bone-like or denser matter."""
    material_from: float = 0.4
    """Share of the run after which the metals' numbers are fitted: before, they would explain blur."""
    spectral_nodes: int | None = None
    """Nodes of the spectrum; None: as few as keep the error of P small."""

    # The detector.
    blur: float = 0.1
    """Variance of the detector's blur along rows and along columns, in squared pixels, that a fit of it starts from."""
    pixel_rays: int | None = None
    """Rays a pixel and axis over which the light is averaged; 1: infinitely thin rays."""

    gains: bool | None = None
    """Whether each pixel's gain is found and taken out; None: where held-out rays confirm it."""
    drift: bool | None = None
    """Whether each view's light is, likewise."""
    beam: bool | None = None
    """Whether what rays beside the object hold is taken out of all rays, as a beam that differs from its open field;
    None: where that is beyond doubt."""

    # The misfit.
    loss: str = "huber"
    """"huber" or "weighted-l1", both weighted by photon statistics, or "l1" (the paper's)."""
    model_error: float = 0.015
    """Error of -log(I/I0) that the model is allowed besides the noise."""
    huber_corner: float = 1.345
    """Deviations beyond which a residual counts absolutely (95 % efficient for Gaussian noise: Huber 1964)."""
    ssim_weight: float = 0.0
    """Weight of 1 - SSIM of the projections (the paper uses 0.25)."""

    # Rates, for each step of the optimiser.
    learning_rate_position: float = 0.03
    """In seed spacings; up to twice as much in a run of fewer than 450 steps, as for the scale."""
    learning_rate_scale: float = 4e-2
    """Relative."""
    learning_rate_rotation: float = 3e-3
    """Of the quaternion; up to seven times as much in a run of fewer than 900 steps."""
    learning_rate_attenuation: float = 1e-2
    """In soft references."""
    learning_rate_material: float = 1e-3
    """Of material numbers outside metal, in a run of 300 steps; less in a longer one, by the root."""
    learning_rate_shared: float = 5e-3
    """Of each piece of metal's one number."""
    learning_rate_blur: float = 1e-2
    """Of the detector's blur, where it is fitted; 0 holds it, and with ``blur`` 0 rays are infinitely thin."""
    final_rate: float = 0.1
    """All rates fall exponentially to this share of their start."""

    def __post_init__(self) -> None:
        for field in fields(self):
            name, value = f"settings[{field.name!r}]", getattr(self, field.name)
            if value is None and field.default is None:
                continue
            if field.name == "agent":
                _require_changes(name, value)
            elif field.name == "memory":
                object.__setattr__(self, field.name, bytes_of(value, name))
            elif field.name in _SWITCHES:
                _require_switch(name, value)
            elif field.name in _CHOICES:
                require_choice(name, value, _CHOICES[field.name])
            else:
                # Made anew with another value two dozen times a run: what was right is not looked at twice.
                number = _seen_number if type(value) in (int, float) else _number
                object.__setattr__(self, field.name, number(name, value, str(field.type)))
        if self.curves not in (None, 1, 3):
            raise fail("settings['curves']", "1, 3, or None for the plan to decide", repr(self.curves))
        if self.curves == 1 and self.soft_u:
            raise fail("settings['curves']", "3 with a soft_u other than 0", "1", "name the soft material")
        if self.light == "fat" and self.soft_u + self.light_u < -0.1:
            raise fail("settings['light_u']", "-0.1 at least, together with soft_u", repr(self.light_u))
        if self.curves == 1 and self.light == "fat":
            raise fail("settings['curves']", "3 where light matter is fat", "1", "one curve has one number")

    def __hash__(self) -> int:
        return hash(tuple(repr(getattr(self, field.name)) for field in fields(self)))

    def to_dict(self) -> dict[str, Any]:
        """Plain values by name."""
        return asdict(self)


def _number(name: str, value: Any, kind: str) -> float | int:
    number = require_number(name, value, **_RANGES.get(name[len("settings['") : -2], {"at_least": 0.0}))
    if not kind.startswith("int"):
        return number
    if number != int(number):
        raise fail(name, "a whole number", repr(value))
    return int(number)


# By type as well: a whole number and the same one with a point are not the same to every setting.
_seen_number = lru_cache(maxsize=512, typed=True)(_number)


def _require_switch(name: str, value: Any) -> None:
    if not isinstance(value, bool):
        raise fail(name, "True, False, or None for the rays to decide", repr(value), error=TypeError)


def _require_changes(name: str, value: Any) -> None:
    """See to it that what an agent changes is numbers by the names of settings."""
    known = {field.name for field in fields(Settings)}
    if not isinstance(value, dict) or any(
        key not in known or type(one) not in (int, float) or not math.isfinite(one)
        for key, one in value.items()
    ):
        raise fail(name, "a dict of numbers by the names of settings", repr(value))


PRESETS: dict[str, dict[str, Any]] = {
    "fast": {"passes": 5.0},
    "balanced": {},
    "best": {"passes": 30.0},
}
_DEFAULT_QUALITY = "balanced"


def make_settings(
    quality: str = _DEFAULT_QUALITY, changes: Mapping[str, Any] | Settings | None = None
) -> Settings:
    """The settings of a preset with some of them changed by name.

    Raises
    ------
    ValueError, TypeError
        For an unknown quality, name or value, and for a quality beside whole settings, which leave it nothing to say.
    """
    require_choice("quality", quality, PRESETS)
    if isinstance(changes, Settings):
        if quality != _DEFAULT_QUALITY:
            remedy = "whole settings hold all that a quality sets: pass a dict of single ones beside it"
            raise fail("quality", "none beside a Settings object", repr(quality), remedy)
        return changes
    if changes is not None and not isinstance(changes, Mapping):
        raise fail("settings", "Settings or a dict of their names", repr(changes), error=TypeError)
    known = sorted(field.name for field in fields(Settings))
    for name in changes or {}:
        if name not in known:
            near = did_you_mean(name, known)
            remedy = near or "docs/settings.md lists them all"
            raise fail("settings", "the name of a setting", repr(name), remedy)
    return replace(Settings(), **{**PRESETS[quality], **(changes or {})})

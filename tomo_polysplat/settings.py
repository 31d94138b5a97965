"""Every tunable of a reconstruction, its unit and its default, and the quality presets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from typing import Any

from tomo_polysplat.checks import did_you_mean, fail, require_choice, require_number

__all__ = ["PRESETS", "Settings", "make_settings"]

# Of those that are not any number from 0 on. Material numbers reach a little below the first curve.
_RANGES: dict[str, dict[str, Any]] = {
    **dict.fromkeys(("soft_u", "bone_u", "metal_u"), {"at_least": -0.1, "at_most": 1.0}),
    "light_u": {"at_least": -0.1, "at_most": 0.1},
    **dict.fromkeys(("seed_width", "largest_scale", "cutoff"), {"above": 0.0}),
    **dict.fromkeys(("model_error", "huber_corner", "final_rate"), {"above": 0.0}),
    "blur": {"at_least": 0.0, "at_most": 0.6},
    "held_out": {"at_least": 0.0, "at_most": 0.5},
    "finer_seeds": {"at_least": 0.0, "at_most": 0.9},
    "metal_tail": {"at_least": 0.0, "at_most": 0.8},
}


@dataclass(frozen=True)
class Settings:
    """Tunables of the solver.

    Lengths are in units of the mean spacing of the seeds or of the voxel, as said; attenuation and density in
    units of the scan's soft reference (water, for most objects).
    """

    passes: float = 0.0
    """Times every view is used, unless held-out rays or a time budget end the run before; 0 leaves it to the plan."""
    views_per_step: int = 0
    """Views whose gradients make one step of the optimiser; 0 leaves it to the plan."""
    max_gaussians: int = 0
    """About how many Gaussians at most, not counting that metal is seeded more finely; 0 leaves it to the plan."""
    seed_spacing: float = 0.0
    """Distance of the seeds in voxels; 0 leaves it to the plan."""
    finer_seeds: float = 0.5
    """Where Gaussians are fewer than the detector could tell apart, the share of them that lies twice as close."""
    seed_width: float = 0.6
    """Standard deviation of a seed in units of the spacing."""
    seed_edge: float = 0.2
    """Variation of the start over a spacing, in soft references, that makes a seed half as thick across the edge, and
    wider along it, where Gaussians are fewer than the detector could tell apart; 0: all seeds are round."""
    edges: str = "auto"
    """"sharp" makes all seeds thin across edges, "blurred" none thinner than the detector could tell apart; "auto"
    finds out by two short fits which of the two an object has."""
    support_level: float = 0.1
    """Where the start is below this share of the soft reference in a seed's cell and those around it, there is none;
    foam and down, whose main matter is lighter than 0.15 of the reference, have it lowered alike."""
    smallest_scale: float = 0.0
    """Smallest standard deviation in voxels, or in seed spacings where seeds are closer; 0 leaves it to the plan."""
    largest_scale: float = 8.0
    """Largest standard deviation in seed spacings."""
    surroundings: float = 0.5
    """Share of its edges that the volume is widened by at most on every side, while it is fitted, where the object
    reaches beyond both the detector and the volume; 0: never."""
    bone_level: float = 2.2
    """Start attenuation, in soft references, above which matter is bone-like, and material numbers are free near it."""
    metal_level: float = 6.0
    """The same for metal, which in an object of one solid is three times as dense as that at least."""
    metal_rim: float = 0.0
    """Level down to which what is connected to metal belongs to it; 0: ``metal_level`` itself."""
    soft_u: float = 0.0
    """Material number of soft matter that the fit starts from; near dense matter it is free."""
    soft_gain: float = 1.0
    """Once a pass the soft matter's number moves by so much times the cupping, where it is one matter; 0 holds it."""
    light: str = "auto"
    """What has 0.65 to 0.95 soft references: "soft" matter that is less dense, or "fat", which hardens the beam less;
    "auto" leaves it to the plan, which asks the rays where there is much of it."""
    light_u: float = -0.056
    """Material number of fat, less that of soft matter; that of adipose tissue by default."""
    bone_u: float = 0.3
    """Material number that matter of four soft references starts from, that of bone (``model/bone_numbers.py``)."""
    metal_u: float = 0.8
    """Material number that metal starts from; at this default, under the default curves, its attenuation tells the
    number after the first pass (``fit/metal_numbers.py``)."""
    free_radius: float = 6.0
    """Gaussians have a material number of their own within this many voxels of bone-like or denser matter."""
    learning_rate_position: float = 0.03
    """Per step, in seed spacings; up to twice as much in a run of fewer than 450 steps, as for the scale."""
    learning_rate_scale: float = 4e-2
    """Per step, relative."""
    learning_rate_rotation: float = 3e-3
    """Per step, of the quaternion; up to seven times as much in a run of fewer than 900 steps."""
    learning_rate_attenuation: float = 1e-2
    learning_rate_material: float = 1e-3
    """Per step of a run of 300, of material numbers outside metal; less in a longer one, by the root."""
    learning_rate_shared: float = 5e-3
    """Of each piece of metal's one number."""
    blur: float = 0.1
    """Variance of the detector's blur along rows and along columns, in squared pixels, that a fit of it starts from."""
    learning_rate_blur: float = 1e-2
    """The blur is fitted where there is metal; 0 holds it, and with ``blur`` 0 rays are infinitely thin."""
    material_from: float = 0.4
    """Share of the run after which the metals' numbers are fitted: before, they would explain blur."""
    final_rate: float = 0.1
    """Learning rates fall exponentially to this share of their start."""
    loss: str = "huber"
    """"huber" or "weighted-l1", both weighted by photon statistics, or "l1" (the paper's)."""
    model_error: float = 0.015
    """Error of -log(I/I0) that the model is allowed besides the noise."""
    huber_corner: float = 1.345
    """Deviations beyond which a residual counts absolutely (95 % efficient for Gaussian noise: Huber 1964)."""
    ssim_weight: float = 0.0
    """Weight of 1 - SSIM of the projections (the paper uses 0.25)."""
    pixel_rays: int = 0
    """Rays a pixel and axis over which the light is averaged; 1: infinitely thin ones; 0 leaves it to the plan, which
    asks the rays at metal."""
    tv_weight: float = 0.04
    """Weight of the total variation per voxel, in soft references."""
    tv_factor: float = 0.0
    """So many times that weight is taken; 0 leaves it to the plan, which asks held-out rays in slices and of thin
    objects."""
    tv_clip: float = 5.0
    """Attenuation above this many soft references does not count as variation, which would erode metal; what is lighter
    than metal, castings of aluminium too, is smoothed."""
    tv_corner: float = 0.0
    """Difference of neighbouring voxels, in soft references, up to which it counts in full; larger ones count by
    their logarithm, so that edges and texture stay. 0 leaves it to the plan; with 1000 all count in full."""
    tv_every: int = 0
    """In every how many steps it is taken, and counts as many times; 0 leaves it to the plan."""
    growth: float = 0.0
    """So many times as many Gaussians as seeds may be there in the end, by splitting; 1: no more of them; 0 leaves it
    to the plan, which asks the rays."""
    relocated: float = 0.03
    """Largest share of the Gaussians that, once a pass, moves from where it holds nothing to where it is wanted."""
    relocate_until: float = 0.5
    """Share of the run after which no Gaussian is moved: the new ones need time to settle."""
    held_out: float = 0.01
    """Share of the rays kept from the fit to tell when it stops improving."""
    patience: int = 0
    """Passes over the views without improvement of the held-out rays that end the run; 0: four in ten, at least 4."""
    metal_tail: float = 0.5
    """A voxel no point of which reaches about this share of the metal around it holds a tail, which that gets back."""
    cutoff: float = 3.0
    """Standard deviations at which a projected Gaussian ends."""
    curves: int = 0
    """Material curves under a spectrum: 1 for the soft one alone, or 3; 0 leaves it to the plan."""
    spectral_nodes: int = 0
    """Nodes of the spectrum; 0 takes as few as keep the error of P small."""
    kernel: str = "auto"
    """"auto", "triton", "numba" or "reference"."""

    def __post_init__(self) -> None:
        require_choice("settings['loss']", self.loss, ("huber", "weighted-l1", "l1"))
        require_choice("settings['edges']", self.edges, ("auto", "sharp", "blurred"))
        require_choice("settings['light']", self.light, ("auto", "soft", "fat"))
        require_choice("settings['kernel']", self.kernel, ("auto", "triton", "numba", "reference"))
        for field in fields(self):
            name, value = f"settings[{field.name!r}]", getattr(self, field.name)
            if isinstance(field.default, str):
                continue
            number = require_number(name, value, **_RANGES.get(field.name, {"at_least": 0.0}))
            if isinstance(field.default, int):
                if number != int(number):
                    raise fail(name, "a whole number", repr(value))
                number = int(number)
            object.__setattr__(self, field.name, number)
        if self.curves not in (0, 1, 3):
            raise fail("settings['curves']", "1, 3, or 0 for the plan to decide", repr(self.curves))
        if self.curves == 1 and self.soft_u:
            raise fail("settings['curves']", "3 with a soft_u other than 0", "1", "name the soft material")
        if self.light == "fat" and self.soft_u + self.light_u < -0.1:
            raise fail("settings['light_u']", "-0.1 at least, together with soft_u", repr(self.light_u))
        if self.curves == 1 and self.light == "fat":
            raise fail("settings['curves']", "3 where light matter is fat", "1", "one curve has one number")

    def to_dict(self) -> dict[str, Any]:
        """Plain values by name."""
        return asdict(self)


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
            raise fail("settings", f"names among {', '.join(known)}", repr(name), did_you_mean(name, known))
    return replace(Settings(), **{**PRESETS[quality], **(changes or {})})

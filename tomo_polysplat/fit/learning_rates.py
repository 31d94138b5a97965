"""Learning rates for the length of a run: in few steps each has to be larger."""

from __future__ import annotations

import math
from dataclasses import replace

from tomo_polysplat.settings import Settings

__all__ = ["hurried"]

# The learning rates of place and size are for this many steps. Fewer steps take larger ones, by the root of how few
# they are, up to twice (pins, 64^3, 160 steps: 25.8 dB as they are, 27.0 with 1.5 times).
_STEPS, _MOST_HURRY = 450, 2.0
# The rate of turns is for this number of steps. It goes with the square, up to the second number as a factor: in 300
# steps a Gaussian would hardly turn (40^3: pepper 30.9 to 31.4 dB, teeth 39.3 to 39.7, lung 33.0 to 33.3), while in 900
# the same rate upsets metal (teeth, 256^3: 58.6 to 57.0 dB everywhere with three times the rate).
_STEPS_OF_TURNS, _MOST_HURRIED_TURNS = 900, 7.0
# The rate of Gaussians' own material numbers is for this number of steps, and goes with the root, too. What rays say of
# a number is little beside what they say of edges that Gaussians blur, and a blurred edge looks like matter of a larger
# number: a number goes on rising for as long as it is fitted. With the inverse instead of the root bone is a little
# better and enamel, farther from where it starts, worse (rods of bone, 800 steps: 40.9 for 40.2 dB; teeth, 256^3: 45.0
# for 45.5).
_STEPS_OF_NUMBERS, _MOST_HURRIED_NUMBERS = 300, 2.0


def hurried(settings: Settings, steps: int) -> Settings:
    """The settings with learning rates for a run of so many steps."""
    factor = min(max(1.0, math.sqrt(_STEPS / steps)), _MOST_HURRY)
    turns = min(max(1.0, (_STEPS_OF_TURNS / steps) ** 2), _MOST_HURRIED_TURNS)
    numbers = min(math.sqrt(_STEPS_OF_NUMBERS / steps), _MOST_HURRIED_NUMBERS)
    return replace(
        settings,
        learning_rate_position=factor * settings.learning_rate_position,
        learning_rate_scale=factor * settings.learning_rate_scale,
        learning_rate_rotation=turns * settings.learning_rate_rotation,
        learning_rate_material=numbers * settings.learning_rate_material,
    )

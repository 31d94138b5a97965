"""The protocol of a nuisance: what the scanner did that is not the object, as numbers that the rays tell.

A nuisance names its parameters, where it acts, what holds what the rays cannot tell, and how its parameters are found.
Its gate says, by numbers that a caller has measured, whether what was found is kept: else the parameters stay at their
start. Which fits are made for that is the plan's concern.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum
from typing import Any, ClassVar

__all__ = ["Found", "Nuisance", "Parameter", "Place", "Verdict"]


class Place(str, Enum):
    """Where a nuisance acts on the forward model."""

    GEOMETRY = "geometry"
    """On the views' vectors."""
    SPECTRUM = "spectrum"
    """On the spectrum, before its nodes are fitted."""
    LIGHT = "light"
    """On the light of each ray, before the logarithm."""
    DETECTOR = "detector"
    """On what the pixels make of it."""


class Found(str, Enum):
    """What the parameters follow."""

    GRADIENT = "gradient"
    """The loss's gradient, at every step."""
    RESIDUALS = "residuals"
    """The residuals that a short fit leaves, linearised."""
    DENSITY = "density"
    """A density that the caller knows."""
    BOTH_WAYS = "both ways"
    """No gradient: a run is made with it and without."""


@dataclass(frozen=True)
class Parameter:
    """A number of a nuisance.

    Attributes
    ----------
    unit : str
    start : float
        Where it does nothing.
    least, most : float
        Ends of its range.
    """

    unit: str
    start: float
    least: float
    most: float


@dataclass(frozen=True)
class Verdict:
    """Whether what was found is kept, and why."""

    kept: bool
    why: str


class Nuisance(ABC):
    """One thing that a scanner did; one a file, none of which knows of Gaussians.

    Attributes
    ----------
    name : str
    place : Place
    parameters : mapping of str to Parameter
    found_by : Found
    gauge : str
        What the rays cannot tell of it, and what holds that.
    cost : str
        What finding it takes.
    """

    name: ClassVar[str]
    place: ClassVar[Place]
    parameters: ClassVar[Mapping[str, Parameter]]
    found_by: ClassVar[Found]
    gauge: ClassVar[str]
    cost: ClassVar[str]

    @classmethod
    @abstractmethod
    def gate(cls, evidence: Mapping[str, float]) -> Verdict:
        """Whether numbers that were measured, by name, confirm it."""

    @classmethod
    @abstractmethod
    def told(cls, values: Mapping[str, Any]) -> str:
        """What a report says of these values of the parameters; nothing where they are at their start."""

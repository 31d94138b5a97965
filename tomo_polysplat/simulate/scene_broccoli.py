"""Broccoli: a branching stalk under heads of hundreds of buds, fine texture everywhere, and a metal screw."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.simulate.blocks import random_turn
from tomo_polysplat.simulate.phantom import Part
from tomo_polysplat.simulate.shapes import cylinder, ellipsoid

__all__ = ["HALF_WIDTH", "parts"]

HALF_WIDTH = 2.5
FORK = np.array([0.0, 0.0, -0.35])
# Heads by centre and radius: one on top, a ring of six about it, a lower ring of four.
HEADS = [
    ((0.0, 0.0, 0.85), 0.75),
    *(((1.15 * np.cos(t), 1.15 * np.sin(t), 0.55), 0.62) for t in np.deg2rad(np.arange(10, 370, 60))),
    *(((1.45 * np.cos(t), 1.45 * np.sin(t), -0.2), 0.48) for t in np.deg2rad(np.arange(40, 400, 90))),
]


def parts() -> list[Part]:
    """The parts in cm, in order of precedence."""
    generator = np.random.default_rng(7)
    listed = []
    for centre, radius in HEADS:
        listed += _head(np.array(centre), radius, generator)
    listed += [Part(cylinder((0, 0, -1.05), 0.42, 0.80), "water", 1.02)]
    listed += [Part(cylinder((0, 0, -1.05), 0.26, 0.75), "water", 0.93)]
    for centre, radius in HEADS:
        listed += _branches(np.array(centre), radius, generator)
    screw = cylinder((0.35, -0.30, 0.25), 0.11, 0.85, (0.25, 0.15, 1.0))
    ball = ellipsoid((-0.95, 0.75, 0.10), 0.17)
    return [*listed, Part(screw, "iron", 7.87, metal=True), Part(ball, "iron", 7.87, metal=True)]


def _head(centre: np.ndarray, radius: float, generator: np.random.Generator) -> list[Part]:
    """Buds at even spacing over a sphere (a golden spiral), in two loose layers with air between them."""
    count = round(110 * (radius / 0.62) ** 2)
    listed = []
    for n in range(count):
        height = 1.0 - (2 * n + 1) / count
        turn = n * np.pi * (3.0 - np.sqrt(5.0))
        across = np.sqrt(1.0 - height**2)
        outward = np.array([across * np.cos(turn), across * np.sin(turn), height])
        depth = radius * generator.uniform(0.72, 0.92)
        semi = generator.uniform(0.055, 0.10, 3)
        shape = ellipsoid(centre + depth * outward, semi, random_turn(generator))
        listed.append(Part(shape, "water", float(generator.uniform(0.86, 1.06))))
    return listed


def _branches(centre: np.ndarray, radius: float, generator: np.random.Generator) -> list[Part]:
    """A limb from the fork of the stalk into a head, and twigs from there to the buds."""
    middle = FORK + 0.75 * (centre - FORK)
    listed = [_limb(FORK, middle, 0.16)]
    for _ in range(14):
        outward = generator.standard_normal(3)
        outward /= np.linalg.norm(outward)
        listed.append(_limb(middle, centre + 0.75 * radius * outward, 0.035))
    return listed


def _limb(start: np.ndarray, stop: np.ndarray, radius: float) -> Part:
    half = float(np.linalg.norm(stop - start)) / 2
    return Part(cylinder((start + stop) / 2, radius, half, stop - start), "water", 0.98)

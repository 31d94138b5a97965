"""Pepper: a hollow bell pepper of four lobes with ribs, core, seeds and stalk, and an iron nail in it."""

from __future__ import annotations

import numpy as np

from tomo_polysplat.simulate.blocks import random_turn
from tomo_polysplat.simulate.phantom import Part
from tomo_polysplat.simulate.shapes import box, cylinder, ellipsoid, rotation

__all__ = ["HALF_WIDTH", "parts"]

HALF_WIDTH = 2.5
LOBES = np.deg2rad([40.0, 130.0, 220.0, 310.0])
WALL = 0.22


def parts() -> list[Part]:
    """The parts in cm, in order of precedence."""
    outer = [ellipsoid((0.78 * np.cos(t), 0.78 * np.sin(t), -0.15), (1.28, 1.28, 1.50)) for t in LOBES]
    skin = [Part(shape, "water", 1.04) for shape in outer]
    flesh = [Part(ellipsoid(s.centre, s.semi - 0.05), "water", 0.92) for s in outer]
    hollow = [Part(ellipsoid(s.centre, s.semi - WALL), "water", 0.0) for s in outer]
    return [*skin, *flesh, *hollow, *_ribs(), *_core(), *_stalk(), *_nail()]


def _ribs() -> list[Part]:
    """Membranes between the lobes."""
    listed = []
    for t in LOBES + np.pi / 4:
        place = (0.95 * np.cos(t), 0.95 * np.sin(t), -0.15)
        listed.append(
            Part(box(place, (0.42, 0.035, 1.05), rotation((0, 0, 1), float(np.degrees(t)))), "water", 0.90)
        )
    return listed


def _core() -> list[Part]:
    """The placenta under the stalk, covered with seeds that are drier inside."""
    generator = np.random.default_rng(21)
    centre, semi = np.array([0.0, 0.0, 0.55]), np.array([0.50, 0.50, 0.60])
    listed = [Part(ellipsoid(centre, semi), "water", 0.80)]
    for n in range(140):
        height = 1.0 - 1.7 * (n + 0.5) / 140
        turn = n * np.pi * (3.0 - np.sqrt(5.0))
        across = np.sqrt(1.0 - height**2)
        outward = np.array([across * np.cos(turn), across * np.sin(turn), height])
        shape = ellipsoid(centre + 1.08 * semi * outward, (0.095, 0.085, 0.03), random_turn(generator))
        listed.append(Part(shape, "pmma", float(generator.uniform(0.95, 1.15))))
    return listed


def _stalk() -> list[Part]:
    return [
        Part(ellipsoid((0, 0, 1.22), (0.70, 0.70, 0.12)), "water", 1.00),
        Part(cylinder((0.05, 0.0, 1.55), 0.20, 0.35, (0.15, 0.05, 1.0)), "water", 1.03),
        Part(cylinder((0.05, 0.0, 1.55), 0.11, 0.35, (0.15, 0.05, 1.0)), "water", 0.85),
    ]


def _nail() -> list[Part]:
    """Shank and head of a nail driven in from the side, and a pellet in the far wall."""
    direction = np.array([1.0, 0.35, 0.25])
    direction /= np.linalg.norm(direction)
    centre = np.array([0.75, 0.25, -0.10])
    shapes = [
        cylinder(centre, 0.085, 1.05, direction),
        cylinder(centre + 1.05 * direction, 0.19, 0.05, direction),
        ellipsoid((-1.45, -0.85, 0.05), 0.14),
    ]
    return [Part(shape, "iron", 7.87, metal=True) for shape in shapes]

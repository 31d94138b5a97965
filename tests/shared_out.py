"""Fits and sums that processes share out, beside those of one."""

import sys

import numpy as np
import torch
from small_scans import ASKED, QUICK
from small_scans import reconstruct as reconstruct_anywhere

from tomo_polysplat.fit.filter_sums import filter_sums
from tomo_polysplat.fit.move_sums import move_sums
from tomo_polysplat.fit.residual_sums import residual_sums
from tomo_polysplat.ranks import ALONE, led_by

# What is added up in another order differs by rounding, which grows with every step. A Gaussian whose gradient is all
# rounding may step either way: so much of nearly all voxels, in the largest one, and so much of the volume, in L2.
SAME, NEARLY_ALL, OF_ALL = 3e-5, 0.95, 1e-4
# Smoothing takes the sign of a slope from it where neighbouring voxels are as good as equal. One process whose volumes
# are rounded otherwise differs by up to 4e-4 in L2, and one that does not smooth by 8e-2.
SMOOTHED = 1e-3
ROUGH = QUICK | ASKED | {"tv_weight": 0.0}


def reconstruct(*args, **options):
    """On the CPU, as the other processes, where no devices are named: a machine with a GPU would take that."""
    where = {} if "devices" in options else {"device": "cpu"}
    return reconstruct_anywhere(*args, **(where | {"calibrate": None} | options))


def relative(volume, reference):
    """Difference over the reference, in L2."""
    return float(np.linalg.norm(volume - reference) / np.linalg.norm(reference))


def same(volume, reference):
    """Whether two volumes differ by rounding alone."""
    apart = np.abs(volume - reference)[reference > 0]
    return np.quantile(apart, NEARLY_ALL) < SAME * reference.max() and relative(volume, reference) < OF_ALL


def told_to(ranks, monkeypatch):
    """What the others are told from now on."""
    told, tell = [], type(ranks).tell
    monkeypatch.setattr(type(ranks), "tell", lambda *message: (told.append(message[1]), tell(*message)))
    return told


def moves_left(gaussians, scene, rays, settings):
    """`move_sums` of made-up moves."""
    falls = np.random.default_rng(0).normal(0, 0.1, (2, len(rays.views), 3, 3))
    return move_sums(gaussians, scene, rays, settings, torch.from_numpy(falls))


def filters_left(gaussians, scene, rays, settings):
    """`filter_sums` of aluminium."""
    return filter_sums(gaussians, scene, rays, settings, scene.quadrature, 2.7)


# Whom `assert_sums_are_those_of_one` compares.
SUMS = [residual_sums, moves_left, filters_left]


def assert_sums_are_those_of_one(sums, fit, ranks, monkeypatch, within):
    """The ``sums`` over the views of a fit, one view at a time, which all ranks share out."""
    for of in (residual_sums, move_sums, filter_sums):
        monkeypatch.setattr(sys.modules[of.__module__], "_AT_ONCE", 1)
    told = told_to(ranks, monkeypatch)
    parts = fit.gaussians, fit.scene, fit.rays, fit.settings
    shared = sums(*parts)
    assert told == ["rays", "work"]
    with led_by(ALONE):
        one = sums(*parts)
    for name, expected in vars(one).items():
        scale = np.nanmax(np.abs(expected))
        np.testing.assert_allclose(getattr(shared, name), expected, atol=within * scale, err_msg=name)
        assert scale > 0, name

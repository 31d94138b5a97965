"""Scans of a few voxels, and what the plan makes of them."""

import numpy as np
import torch

from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.plan.decision import When
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.lab import Lab
from tomo_polysplat.plan.order import decide, decide_start, plan_from_start
from tomo_polysplat.plan.plan import Plan
from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, from_astra, projections_from_astra
from tomo_polysplat.settings import Settings


def problem(
    size=12,
    factor=1.0,
    unit="cm",
    polychromatic=False,
    planar=False,
    stretch=(1, 1, 1),
    pixel=1.0,
    height=0.0,
    views=20,
):
    """A parallel scan of a window of 2 x 2 x 2 ``unit`` times ``factor``; ``pixel`` is in voxels."""
    angles = np.linspace(0, np.pi, views, endpoint=False)
    shape = (1 if planar else size, size, size)
    half = np.ones(3) if not planar else np.array([1, 1, 1 / size])
    half = half * np.array(stretch)
    step = pixel * 2 / size
    rows, columns = (1 if planar else size), size
    u = step * np.stack([np.cos(angles), np.sin(angles), 0 * angles], 1)
    v = step * np.tile([0.0, 0, 1], (views, 1))
    origin = np.stack([-np.sin(angles), np.cos(angles), 0 * angles], 1)
    corner = -0.5 * (columns - 1) * u - 0.5 * (rows - 1) * v + [0, 0, height]
    geometry = Geometry("parallel", origin, corner * factor, u * factor, v * factor, rows, columns)
    grid = VolumeGrid(shape, -half * factor, half * factor)
    spectrum = Spectrum.from_tube(90, filters={}, detector="counting") if polychromatic else None
    values = np.ones((views, rows, columns), np.float32)
    return Problem.of(values, geometry, grid, unit, spectrum, Materials() if polychromatic else None)


def ball(of, density):
    z, y, x = np.meshgrid(*(np.linspace(-1, 1, n) if n > 1 else [0.0] for n in of.grid.shape), indexing="ij")
    return np.where(x**2 + y**2 + z**2 < 0.8, np.float32(density * of.depth), np.float32(0))


def plan(of, start, device="cpu", **settings):
    return plan_from_start(torch.as_tensor(start), of, Settings(**settings), torch.device(device))


def why(plan, name):
    """What a plan says of a decision or a fact."""
    return plan.told()[name].why


def planned(**values):
    """A plan of these values, by name."""
    return Plan({name: Answer.found(value) for name, value in values.items()})


def lab_of(of, budget=None, **settings):
    """A lab of a scan, with what its start volume tells."""
    device, chosen = torch.device("cpu"), Settings(**settings)
    lab = Lab(of, first_volume(of, device, chosen)[0], chosen, device, time_budget=budget)
    decide_start(lab)
    return lab


def told_beforehand(scan, name, materials=None, calibrate=None, **settings):
    """What a run of a scan begins with as the answer to a question that is asked in its middle, or None."""
    values = projections_from_astra(scan.projections, scan.proj_geom).copy()
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    lab = lab_of(Problem.of(values, geometry, grid, scan.unit, scan.spectrum, materials), **settings)
    lab.gaussians, lab.calibrate = lab.seeds(), calibrate
    decide(lab, When.DURING)
    return lab.plan.answers.get(name)

"""Whole fits and the physics of fitted Gaussians in float32 and in float64."""

from __future__ import annotations

import time
from dataclasses import fields, replace

import numpy as np
import torch

from tomo_polysplat.bench.hard_cases.case import Case, Findings
from tomo_polysplat.bench.hard_cases.easy import (
    PASSES,
    SPREAD_OF_A_SLICE,
    fit,
    orbit,
    psnr_of,
    scan_of,
    soft_cone,
    tube,
)
from tomo_polysplat.bench.hard_cases.gaussians import compare_precisions
from tomo_polysplat.bench.hard_cases.same import relative_rms
from tomo_polysplat.fit.optimise import Course
from tomo_polysplat.fit.optimise import fit as optimise
from tomo_polysplat.fit.problem import Problem
from tomo_polysplat.fit.setup import FitSetup
from tomo_polysplat.model.gaussians import Gaussians
from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.quadrature import fit_quadrature
from tomo_polysplat.physics.transmission import polychromatic_projection
from tomo_polysplat.plan.first_gaussians import first_gaussians
from tomo_polysplat.plan.first_volume import first_volume
from tomo_polysplat.plan.model import rays_of, scene_of
from tomo_polysplat.plan.order import plan_from_start
from tomo_polysplat.render.renderer import detector_views
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.settings import make_settings

__all__ = ["CASES"]


def _fitted_kernels(device: str) -> Findings:
    """The Gaussians of the easy cone, projected onto a tenth of its views."""
    scan = soft_cone()
    gaussians = fit(scan, device).gaussians
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    views = detector_views(geometry.select(slice(None, None, 10)), planar=False)
    parts = [np.asarray(gaussians[name], np.float32) for name in ("position", "scale", "rotation")]
    density = np.asarray(gaussians["density"], np.float32)
    scene = [torch.from_numpy(part).double() for part in (*parts, np.stack([density] * 3))]
    findings = Findings()
    # Cut where the step is small: a pixel that float32 puts on its other side is no error of the kernel.
    compare_precisions(findings, scene, views, device, cutoff=4.5)
    return findings


def _material_ends(device: str) -> Findings:
    """P of rays through matter of u = 0 and u = 1 and of density 0 and 1e6: values and slopes in both precisions."""
    findings = Findings()
    quadrature = fit_quadrature(tube(), Materials(), max_path=15.0)
    u = torch.tensor([0.0, 1.0, 0.0, 1.0, 0.5, 0.5], dtype=torch.float64)
    areal = torch.tensor([1.0, 1.0, 1e6, 1e6, 0.0, 1e6], dtype=torch.float64)
    outcomes = []
    for dtype, where in ((torch.float64, "cpu"), (torch.float32, device)):
        material, amount = (t.to(where, dtype).requires_grad_() for t in (u, areal))
        curves = torch.stack([(1 - material).square(), 2 * material * (1 - material), material.square()])
        projection = polychromatic_projection(curves * amount, quadrature)
        slopes = torch.autograd.grad(projection.sum(), (material, amount))
        outcomes.append([t.detach().cpu().double() for t in (projection, *slopes)])
    # P of no matter is nothing but for the rounding of its terms, which are as large as 1.
    rounding = (4 * torch.finfo(torch.float32).eps, 0.0, 0.0)
    for name, truth, got, of_terms in zip(("P", "dP/du", "dP/d density"), *outcomes, rounding):
        scale = truth.abs().clamp(min=float(truth.abs().median()) * 1e-6)
        error = ((got - truth).abs() - of_terms).clamp(min=0.0)
        findings.at_most(f"error of {name}", float((error / scale).max()), 1e-4)
    return findings


def _fit_in(scan: Scan, dtype: torch.dtype) -> np.ndarray:
    """The volume in 1/cm of a fit with the reference kernel in one precision, as ``reconstruct`` makes it."""
    target, settings = (
        torch.device("cpu"),
        make_settings(changes={"passes": PASSES, "kernel": "reference", "curves": 3}),
    )
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    values = projections_from_astra(scan.projections, scan.proj_geom)
    problem = Problem.of(values.copy(), geometry, grid, "cm", scan.spectrum, None)
    start, _ = first_volume(problem, target, settings)
    plan = plan_from_start(start, problem, settings, target)
    scene, rays = scene_of(problem, plan, settings, target), rays_of(problem, plan, settings, target)
    seeds, _ = first_gaussians(start, plan, problem, settings, target)
    curves = {name: getattr(scene, name).to(dtype) for name in ("reference_curve", "output_curve")}
    scene, rays = replace(scene, **curves), replace(rays, projections=rays.projections.to(dtype))
    parts = {field.name: getattr(seeds, field.name) for field in fields(seeds)}
    seeds = Gaussians(**{k: t if k == "group" else t.to(dtype) for k, t in parts.items()})
    outcome = optimise(
        FitSetup(seeds, plan.spacing * problem.voxel, rays, scene, settings),
        Course(
            views_per_step=plan.views_per_step,
            rng=np.random.default_rng(0),
            started=time.perf_counter(),
            volume=lambda gaussians: np.zeros(0),
        ),
    )
    with torch.no_grad():
        volume = scene.volume(outcome.gaussians).numpy()
    return volume * plan.reference * problem.soft_attenuation()


def _whole_fit(device: str) -> Findings:
    """The reference kernel in float64, in float32, and the fast kernel in float32."""
    scan = scan_of(*orbit(size=24, views=40))
    double, single, fast = (
        _fit_in(scan, torch.float64),
        _fit_in(scan, torch.float32),
        fit(scan, device).volume,
    )
    other_seed, findings = relative_rms(fit(scan, device, seed=1).volume, fast), Findings()
    for name, volume in (("float32 reference", single), ("float32 fast kernel", fast)):
        loss = psnr_of(double, scan) - psnr_of(volume, scan)
        findings.at_most(f"PSNR lost by the {name}, dB", loss, SPREAD_OF_A_SLICE)
        findings.at_most(f"relative rms distance of the {name}", relative_rms(volume, double), other_seed)
    return findings


CASES = (
    Case("fitted-gaussians", "float32 to 1e-5 in the image and 1e-4 in every gradient", _fitted_kernels),
    Case(
        "material-ends",
        "u of 0 and 1, densities of 0 and 1e6: float32 to 1e-4 in P and its slopes",
        _material_ends,
    ),
    Case("float64-fit", "a fit amplifies rounding: less than another seed changes it", _whole_fit, 300.0),
)

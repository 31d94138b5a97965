"""Tiny scans that make every decision of the plan answer both ways at least once, for ``same_as.py``."""

from __future__ import annotations

import contextlib
import hashlib
import importlib
import json
import os
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch

import tomo_polysplat as tps

# An installed package maps this folder; a bare tree has it beside the package.
tps.__path__.append(os.environ.get("SAME_AS_TREE", str(Path(__file__).resolve().parents[1])))

CASES: dict[str, Callable[[], Any]] = {}


def case(function: Callable[[], Any]) -> Callable[[], Any]:
    CASES[function.__name__] = function
    return function


def digest(*arrays: Any) -> str:
    whole = hashlib.sha256()
    for array in arrays:
        whole.update(np.ascontiguousarray(array).tobytes())
    return whole.hexdigest()


def digests(result: Any) -> dict[str, str]:
    history = [{k: v for k, v in entry.items() if k != "seconds"} for entry in result.history]
    return {
        "volume": digest(result.volume),
        "gaussians": digest(*(result.gaussians[name] for name in sorted(result.gaussians))),
        "history": hashlib.sha256(json.dumps(history, sort_keys=True).encode()).hexdigest(),
    }


def fitted(scan: Any, settings: dict[str, Any] | None = None, **options: Any) -> Any:
    options = {"spectrum": scan.spectrum, "unit": scan.unit, "progress": False, "device": "cpu"} | options
    return tps.reconstruct(scan.projections, scan.proj_geom, scan.vol_geom, settings=settings, **options)


def shells(blur: float) -> Any:
    """Nested shells of 31^3 voxels in a parallel beam, sharp or blurred by so many voxels."""
    from scipy import ndimage

    from tomo_polysplat.scan.geometry import Geometry, VolumeGrid, to_astra
    from tomo_polysplat.start.joseph import JosephProjector

    size, views, finer = 31, 44, 3
    angles = np.linspace(0, np.pi, views, endpoint=False)
    zero, step, pixels = 0 * angles, 2 / (1.4 * size), round(1.4 * size)
    u = step * np.stack([np.cos(angles), np.sin(angles), zero], 1)
    v = step * np.tile([0.0, 0, 1], (views, 1))
    ray = np.stack([-np.sin(angles), np.cos(angles), zero], 1)
    geometry = Geometry("parallel", ray, -0.5 * (pixels - 1) * (u + v), u, v, pixels, pixels)
    fine = VolumeGrid((finer * size,) * 3, -np.ones(3), np.ones(3))
    z, y, x = np.meshgrid(*fine.axes()[::-1], indexing="ij")
    far = np.sqrt(x**2 + (1.2 * y) ** 2 + (z - 0.1) ** 2)
    matter = np.where((far < 0.85) & (far > 0.68) | (far < 0.45) & (far > 0.3), 0.5, 0.0)
    matter = ndimage.gaussian_filter(matter, finer * blur)
    values = JosephProjector(geometry, fine).forward(matter.astype(np.float32))
    values = values + np.random.default_rng(0).normal(0, 0.003, values.shape)
    proj_geom, vol_geom = to_astra(geometry, VolumeGrid((size,) * 3, fine.lower, fine.upper))
    return values.astype(np.float32).swapaxes(0, 1), proj_geom, vol_geom


def plain(scan: tuple[Any, Any, Any], settings: dict[str, Any], **options: Any) -> Any:
    options = {"unit": "cm", "progress": False, "device": "cpu"} | options
    return tps.reconstruct(*scan, settings=settings, **options)


def discs(noise: float, pixels: int = 61, views: int = 60) -> tuple[Any, Any, Any]:
    """Line integrals of discs of plastic in water, of 45^2 voxels over half a centimetre."""
    import astra

    width, half = 1.2 / pixels / 2, 0.25
    across = (np.arange(pixels) - (pixels - 1) / 2) * width
    angles = np.arange(views) * np.pi / views
    values = np.zeros((views, pixels))
    for x, y, radius, mu in ((0, 0, 0.22, 1.0), (0.08, 0.05, 0.05, 0.2), (-0.09, 0.02, 0.04, -0.3)):
        off = across - (x * np.cos(angles) + y * np.sin(angles))[:, None]
        values += 2 * mu * np.sqrt(np.maximum(radius**2 - off**2, 0))
    values += np.random.default_rng(0).normal(0, noise, values.shape)
    proj_geom = astra.create_proj_geom("parallel", width, pixels, angles)
    return values.astype(np.float32), proj_geom, astra.create_vol_geom(45, 45, -half, half, -half, half)


def asked_of_small_volumes() -> None:
    """Have the question about fat asked of volumes that are small for it."""
    # Another tree that is installed may have modules that this one lacks.
    here = Path(tps.__file__).parent
    for name in ("plan/decisions/light", "fit/fat"):
        if (here / f"{name}.py").exists():
            module = importlib.import_module(f"tomo_polysplat.{name.replace('/', '.')}")
            module._FEWEST_VOXELS = 10  # type: ignore[attr-defined]


@case
def metal_fan() -> Any:
    return fitted(tps.simulate_scan("pins", size=48, views=40, geometry="fan"), {"passes": 11})


@case
def fan_without_metal() -> Any:
    return fitted(tps.simulate_scan("pins", size=48, views=40, geometry="fan", metal=False), {"passes": 11})


@case
def cone_without_metal() -> Any:
    return fitted(tps.simulate_scan("pins", size=24, views=40, metal=False), {"passes": 4})


@case
def cone_with_metal() -> Any:
    return fitted(tps.simulate_scan("teeth", size=31, views=41), {"passes": 10})


@case
def sharp_shells() -> Any:
    return plain(shells(0.0), {"passes": 6})


@case
def blurred_shells() -> Any:
    return plain(shells(1.5), {"passes": 6})


@case
def broccoli_grows() -> Any:
    return fitted(tps.simulate_scan("broccoli", size=33, views=44, metal=False, photons=1e5), {"passes": 6})


@case
def noisy_slice() -> Any:
    return plain(discs(0.05), {"passes": 10, "held_out": 0.03})


@case
def clean_slice() -> Any:
    return plain(discs(0.0003), {"passes": 10, "held_out": 0.03})


@case
def named_iodine() -> Any:
    scan = tps.simulate_scan("pins", size=40, views=40, geometry="fan")
    return fitted(scan, {"passes": 3}, materials=("water", "bone", "I"))


@case
def pancreas_asked_about_fat() -> Any:
    asked_of_small_volumes()
    scan = tps.simulate_scan("pancreas", size=19, views=41)
    return fitted(
        scan, {"passes": 10, "edges": "blurred", "tv_factor": 1.0, "pixel_rays": 1, "soft_gain": 0.0}
    )


@case
def pancreas_is_fat() -> Any:
    return fitted(tps.simulate_scan("pancreas", size=19, views=41), {"passes": 4, "light": "fat"})


@case
def scatter_is_found() -> Any:
    scan = tps.simulate_scan("pins", size=40, views=60, geometry="fan", scatter=0.05)
    return fitted(scan, {"passes": 6, "tv_factor": 1.0, "pixel_rays": 1})


@case
def voltage_is_calibrated() -> Any:
    scan = tps.simulate_scan("pins", size=32, views=44, geometry="fan", metal=False)
    return fitted(scan, {"passes": 3}, calibrate=True, soft_density=1.0)


@case
def region_of_interest() -> Any:
    import astra

    values, proj_geom, _ = discs(0.001)
    half = 14.5 * proj_geom["DetectorWidth"]
    angles = proj_geom["ProjectionAngles"]
    inner = astra.create_proj_geom("parallel", proj_geom["DetectorWidth"], 29, angles)
    window = astra.create_vol_geom(27, 27, -half, half, -half, half)
    return plain((values[:, 16:45], inner, window), {"passes": 6})


@case
def main_solid() -> Any:
    scan = tps.simulate_scan("pins", size=32, views=44, geometry="fan", metal=False)
    import dataclasses

    return fitted(dataclasses.replace(scan, projections=4 * scan.projections), {"passes": 3})


@case
def stopped_early() -> Any:
    scan = tps.simulate_scan("pins", size=32, views=44, geometry="fan")
    passes: list[Any] = []
    return fitted(scan, {"passes": 12}, callbacks=[lambda state: passes.append(1) or len(passes) == 3])


@case
def killed_and_resumed() -> Any:
    scan = tps.simulate_scan("pins", size=48, views=40, geometry="fan")
    with tempfile.TemporaryDirectory() as folder:
        path, passes = Path(folder) / "fit.npz", []

        def killing(state: Any) -> None:
            passes.append(state.iteration)
            if len(passes) == 3:
                raise MemoryError("killed")

        with contextlib.suppress(MemoryError):
            fitted(scan, {"passes": 11}, checkpoint=path, callbacks=[killing])
        return fitted(scan, {"passes": 11}, checkpoint=path, resume=True)


@case
def slices_of_tomopy() -> Any:
    values, proj_geom, _ = discs(0.001, pixels=33, views=44)
    tomo = np.stack([values, 0.9 * values]).astype(np.float32)
    recon = np.zeros((2, 33, 33), np.float32)
    results: list[Any] = []
    tps.polysplat(
        tomo,
        np.full(2, 16.5, np.float32),
        recon,
        np.asarray(proj_geom["ProjectionAngles"], np.float32),
        num_gridx=33,
        num_gridy=33,
        options={"settings": {"passes": 3}, "on_result": results.append, "device": "cpu", "progress": False},
    )
    return results[0]


def main() -> None:
    """Print the digests of the cases named, or of all, as one line of JSON."""
    torch.set_num_threads(1)
    found = {name: digests(CASES[name]()) for name in sys.argv[1:] or CASES}
    print(json.dumps(found))


if __name__ == "__main__":
    main()

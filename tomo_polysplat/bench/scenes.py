"""Simulated scans for benchmarks, kept on disk because simulating costs more than reconstructing."""

from __future__ import annotations

import hashlib
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

import tomo_polysplat
from tomo_polysplat.checks import require_choice
from tomo_polysplat.scan.io import load_scan, save_scan
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.scenes import SCENES, simulate_scan

__all__ = ["cache_folder", "cached_scan", "fewer_views", "object_of", "require_scene"]

# A scene's name with this ending is the scene without its metal.
_CONTROL = "-control"


def require_scene(name: str) -> str:
    """The name of a scene, checked: one of ``simulate.SCENES``, with ``-control`` after it for none of its metal."""
    require_choice("scenes", object_of(name), SCENES)
    return name


def object_of(name: str) -> str:
    """The scene that a name stands for, with its metal or without."""
    return name.removesuffix(_CONTROL)


def cache_folder() -> Path:
    """This user's folder of simulated scans among the system's temporary files; made if need be."""
    user = getattr(os, "getuid", lambda: "user")()
    folder = Path(tempfile.gettempdir()) / f"tomo-polysplat-scans-{user}"
    folder.mkdir(mode=0o700, exist_ok=True)
    if hasattr(os, "getuid") and folder.stat().st_uid != os.getuid():
        raise PermissionError(f"{folder} belongs to somebody else; name another folder")
    return folder


def cached_scan(scene: str, size: int, views: int, *, folder: Path | None = None, **options: Any) -> Scan:
    """`simulate_scan`, or what it gave the last time that it was asked the same.

    Parameters
    ----------
    scene : str
        See `require_scene`.
    size, views, options
        Of :func:`~tomo_polysplat.simulate.scenes.simulate_scan`.
    folder : path, optional
        Where scans are kept; None for `cache_folder`.
    """
    if scene.endswith(_CONTROL):
        options["metal"] = False
    asked = repr((scene, size, views, sorted(options.items()), _sources()))
    name = f"{scene}-{size}-{views}-{hashlib.sha256(asked.encode()).hexdigest()[:16]}.npz"
    path = (cache_folder() if folder is None else folder) / name
    if not path.exists():
        save_scan(simulate_scan(object_of(scene), size, views, **options), path, overwrite=True)
    scan = load_scan(path)
    scan.name = scene
    return scan


def _sources() -> str:
    """A digest of the code that simulates, so that a scan does not outlive it."""
    digest = hashlib.sha256()
    package = Path(tomo_polysplat.__file__).parent
    for part in ("simulate", "physics"):
        for path in sorted((package / part).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def fewer_views(scan: Scan, least: int) -> Scan:
    """The same scan with only every n-th view, as few as there can be without going below `least`."""
    step = max(1, scan.views // least)
    views = np.arange(0, scan.views, step)
    key = "Vectors" if "Vectors" in scan.proj_geom else "ProjectionAngles"
    return replace(
        scan,
        projections=scan.projections[:, views],
        proj_geom={**scan.proj_geom, key: scan.proj_geom[key][views]},
        valid=None if scan.valid is None else scan.valid[:, views],
    )

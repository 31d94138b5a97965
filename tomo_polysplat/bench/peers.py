"""Other people's reconstructions as methods, where their packages are installed; none is a dependency.

mbirtorch 0.2 (BSD 3-Clause): model-based iterative reconstruction with the qGGMRF prior, and two ways with metal:
low weights for rays that meet it, and a polynomial correction of plastic and metal. It is told the geometry and
the projections, as every method here, and neither a spectrum nor a metal mask.
"""

from __future__ import annotations

import contextlib
import io
import warnings
from typing import Any

import numpy as np

from tomo_polysplat.bench.task import Options, Outcome, Task

__all__ = ["Skipped", "mbirtorch_mar", "mbirtorch_plastic_metal", "mbirtorch_recon"]

# Relative to the source's distance; circular scans are far closer to a circle than this.
_TOLERANCE = 1e-5


class Skipped(Exception):
    """A method that cannot take part here; the message says why."""


def mbirtorch_recon(task: Task, _: Options) -> Outcome:
    """Plain MBIR with transmission weights, ``exp(-P)``."""
    package, model, sinogram, unseen = _set_up(task)
    weights = _without(package.gen_weights(sinogram, "transmission"), unseen)
    return _finished(task, model.recon(sinogram, weights=weights, logfile_path=None, print_logs=False))


def mbirtorch_mar(task: Task, _: Options) -> Outcome:
    """MBIR from weights that are low along metal, which a first plain MBIR finds by Otsu's threshold."""
    package, model, sinogram, unseen = _set_up(task)
    plain = _without(package.gen_weights(sinogram, "transmission"), unseen)
    quiet = {"logfile_path": None, "print_logs": False}
    first, _about = model.recon(sinogram, weights=plain, **quiet)
    with contextlib.redirect_stdout(io.StringIO()):
        weights = package.gen_weights_mar(model, sinogram, init_recon=first)
    return _finished(
        task, model.recon(sinogram, weights=_without(weights, unseen), init_recon=first, **quiet)
    )


def mbirtorch_plastic_metal(task: Task, _: Options) -> Outcome:
    """MBIR alternating with a polynomial beam-hardening correction of plastic and one metal."""
    package, model, sinogram, unseen = _set_up(task)
    weights = _without(package.gen_weights(sinogram, "transmission"), unseen)
    with contextlib.redirect_stdout(io.StringIO()):
        outcome = model.recon_plastic_metal(sinogram, weights, logfile_path=None)
    return _finished(task, outcome)


def _set_up(task: Task) -> tuple[Any, Any, np.ndarray, np.ndarray]:
    """The package, its model of the scan, the sinogram in its order, and which of it was not measured."""
    try:
        import mbirtorch
    except ImportError as error:
        raise Skipped(f"mbirtorch cannot be imported ({error}); python -m pip install mbirtorch") from error
    angles, reverse, settings = cone_parameters(task)
    distances = (settings.pop("source_detector_dist"), settings.pop("source_iso_dist"))
    with warnings.catch_warnings():
        # Until it is told the pixels it assumes large ones, and warns of the cone that they would make.
        warnings.simplefilter("ignore")
        model = mbirtorch.ConeBeamModel(task.projections.shape, angles, *distances)
    model.set_params(verbose=0, no_warning=True, **settings)
    model.configure_devices(devices=["cuda:0" if task.device == "cuda" else task.device])
    sinogram = np.ascontiguousarray(task.projections[:, :: reverse[0], :: reverse[1]])
    unseen = ~np.isfinite(sinogram)
    sinogram[unseen] = np.max(sinogram, initial=0.0, where=~unseen)
    return mbirtorch, model, sinogram, unseen


def cone_parameters(task: Task) -> tuple[np.ndarray, tuple[int, int], dict[str, Any]]:
    """A circular cone-beam scan in mbirtorch's words.

    Its source lies at ``(sin a, cos a)`` times its distance from the axis, its channels run along
    ``(cos a, -sin a)`` and its rows along +z; lengths in cm give 1/cm.

    Returns
    -------
    angles : (views,) float64
    reverse : (int, int)
        1, or -1 where rows or columns run the other way.
    settings : dict
        Of ``ConeBeamModel``, by name.

    Raises
    ------
    Skipped
        For anything but a circular cone beam about an axis through the middle of the volume with cubic voxels.
    """
    geometry, grid = task.geometry, task.grid
    source = geometry.origin - grid.centre
    angles = np.arctan2(source[:, 0], source[:, 1])
    across = np.stack([np.cos(angles), -np.sin(angles), np.zeros_like(angles)], axis=1)
    towards = np.stack([np.sin(angles), np.cos(angles), np.zeros_like(angles)], axis=1)
    radius = np.hypot(source[:, 0], source[:, 1])
    middle = geometry.centre - grid.centre
    columns, rows = (geometry.u * across).sum(axis=1), geometry.v[:, 2]
    distance = radius - (middle * towards).sum(axis=1)
    numbers = np.stack(
        [radius, source[:, 2], columns, rows, distance, (middle * across).sum(axis=1), middle[:, 2]]
    )
    aligned = np.allclose(geometry.u, columns[:, None] * across, atol=_TOLERANCE * abs(columns[0]))
    aligned &= np.allclose(geometry.v, rows[:, None] * [0.0, 0.0, 1.0], atol=_TOLERANCE * abs(rows[0]))
    if geometry.beam != "cone" or not aligned or np.ptp(numbers, axis=1).max() > _TOLERANCE * radius[0]:
        raise Skipped("mbirtorch is asked for circular cone beams about the middle of the volume only")
    if np.ptp(grid.voxel_size) > _TOLERANCE * grid.voxel_size[0]:
        raise Skipped("mbirtorch is asked for cubic voxels only")
    _, height, column, row, length, sideways, upwards = (float(n) for n in numbers.mean(axis=1))
    nz, ny, nx = grid.shape
    return (
        angles,
        (-1 if row < 0 else 1, -1 if column < 0 else 1),
        {
            "source_detector_dist": length,
            "source_iso_dist": float(radius.mean()),
            "delta_det_channel": abs(column),
            "delta_det_row": abs(row),
            "det_channel_offset": -sideways,
            "det_row_offset": height - upwards,
            "recon_slice_offset": -height,
            "delta_voxel": float(grid.voxel_size[0]),
            "recon_shape": (ny, nx, nz),
        },
    )


def _without(weights: Any, unseen: np.ndarray) -> np.ndarray:
    """Weights that leave out what was not measured as far as positive ones can."""
    weights = np.asarray(weights, np.float32)
    return np.where(unseen, 1e-6 * weights.max(), weights)


def _finished(task: Task, outcome: tuple[Any, dict[str, Any]]) -> Outcome:
    """Volume (z, y, x) with what there is to say."""
    volume, record = outcome
    iterations = record.get("recon_params", {}).get("num_iterations")
    return np.ascontiguousarray(np.asarray(volume).transpose(2, 0, 1)), {"iterations": iterations}

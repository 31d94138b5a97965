"""How much memory a fit takes, estimated before it starts, and what to do where there is too little."""

from __future__ import annotations

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import torch

from tomo_polysplat.checks import fail
from tomo_polysplat.free_memory import available_memory, free_bytes, give_back, in_gigabytes, require_memory
from tomo_polysplat.kernels.portions import FOOTPRINTS
from tomo_polysplat.ranks import current_ranks

__all__ = [
    "StepSize",
    "free_bytes",
    "has_room",
    "projections_stay",
    "require_machine",
    "require_room",
    "room_for_gaussians",
    "start_bytes",
    "start_stays",
    "step_bytes",
    "told_of_lack",
    "voxels_at_once",
]

logger = logging.getLogger(__name__)

# Bytes a Gaussian takes: 56 for parameters, 96 for moments, 4 for pull, and 56 for a copy while a step is recorded or
# Gaussians are sorted anew, or for the best copy on a CPU; what a step makes of it on its way, with gradients; and its
# footprint and sums in each view of a step. On a GPU the last two are those of a portion at a time.
# Of several ranks each has these of its part, and the first one between passes parameters, moments, pull and a place in
# a part of all of them.
_GAUSSIAN, _PASSING, _FOOTPRINT, _WHOLE = 212, 468, 144, 164
# Bytes a pixel of a step takes: image and gradient of four channels, projections and their slopes.
_PIXEL = 48
# Bytes a voxel takes at once, by torch's own count on 40^3 to 64^3 (tests/fit/test_counted_memory.py): while a start is
# looked at and seeded; in a step, with the smoothing, on the CPU and by the kernels of a GPU, which hold the volume and
# its slope; while a volume is made of three curves and metal. And the samples of thin Gaussians (render.renderer).
_SEEDED, _SMOOTHED, _MADE, _SAMPLES = 32, {"cpu": 22, "cuda": 13}, 64, 12 << 25
# Voxels of a start around which windows are looked at together (model.seed_samples), and bytes of one on top.
_WINDOW, _WINDOWED = 1 << 25, 22
# Voxels that are made at once at most: a larger volume is no faster in one piece.
_LARGEST_SLAB = 1 << 26
# Copies of the projections that there is room for: themselves, as if all were one material, and as much for the first
# volumes. What is filtered and backprojected of them at a time takes less than 2 GB (`start.astra_fdk.views_at_once`).
_COPIES = 3
# Bytes of the host that a ray takes besides what a scan holds: in the fit's order, whether it is good, and what is made
# of that in passing; on a CPU also what the start makes of it (20.5 more from 2e7 to 6e7 rays). An energy, whose ray
# is traced through so many paths and kept three times (runs of 3000 and 12 000 energies); and a voxel of a result.
_RAY, _ENERGY, _RESULT = {"cpu": 21, "cuda": 8}, 3 * 8 * 2048, 24
# Of what is free: the rest is the driver's, other programs', and lost between blocks.
_SHARE = 0.9


def voxels_at_once(device: torch.device) -> int:
    """Voxels of a slab for which there is room while a volume is made, at least one."""
    free = available_memory() if device.type == "cpu" else free_bytes(device)
    if free is None:
        return _LARGEST_SLAB
    if device.type != "cpu" and torch.cuda.mem_get_info(device)[0] < _LARGEST_SLAB * _MADE:
        # What torch keeps counts as free; but what recorded graphs need, amid a run, only they can use.
        give_back()
        free = min(free, torch.cuda.mem_get_info(device)[0])
    return min(max(int(0.5 * _SHARE * free / _MADE), 1), _LARGEST_SLAB)


def projections_stay(size: int, device: torch.device) -> bool:
    """Whether projections of ``size`` bytes fit on the device, with what is made of them at the start."""
    return device.type == "cpu" or _COPIES * size <= _SHARE * free_bytes(device)


def start_stays(voxels: int, device: torch.device) -> bool:
    """Whether a start of so many voxels is looked at and seeded on the device, or on the host for want of room."""
    return device.type == "cpu" or start_bytes(voxels) <= _SHARE * free_bytes(device)


def start_bytes(voxels: int) -> int:
    """Bytes that a start of so many voxels takes while it is looked at and seeded."""
    return voxels * _SEEDED + min(voxels, _WINDOW) * _WINDOWED


def require_machine(rays: int, voxels: int, energies: int, device: torch.device) -> None:
    """Refuse a scan that cannot be fitted on this machine whatever the plan, before anything is made of it.

    Parameters
    ----------
    rays, voxels, energies : int
        Of the projections, the volume and the spectrum.
    device : torch.device

    Raises
    ------
    MemoryError
        If the host, or a CUDA device, has too little memory left; with bytes needed, bytes free, and remedies.
    """
    remedies = {
        "projections": "bin the detector's pixels, take fewer views, or crop its rows",
        "vol_geom": "take fewer or larger voxels, or a smaller window of the object",
        "spectrum": "rebin the spectrum: some hundreds of energies are as good",
    }
    # A GPU that has no room for the projections leaves them, and what the start makes of them, to the host.
    leave = device.type == "cuda" and projections_stay(4 * rays, device)
    a_ray = _RAY["cuda" if leave else "cpu"]
    a_voxel = _SMOOTHED["cpu"] if device.type == "cpu" else _RESULT
    of_voxels = voxels * a_voxel
    if not start_stays(voxels, device):
        of_voxels = max(of_voxels, start_bytes(voxels))
    needed = {
        "projections": (f"{rays} rays", float(rays * a_ray)),
        "vol_geom": (f"{voxels} voxels", float(of_voxels)),
        "spectrum": (f"{energies} energies", float(energies * _ENERGY)),
    }
    if leave:
        # Where a GPU takes them they have left the host when it gets a volume.
        require_memory({name: need for name, need in needed.items() if name != "vol_geom"}, remedies)
        del needed["projections"]
    require_memory(needed, remedies)
    smoothed = voxels * _SMOOTHED["cuda"]
    if device.type == "cuda" and smoothed > _SHARE * free_bytes(device):
        expected = f"voxels that fit into the {in_gigabytes(free_bytes(device))} free on {device}"
        got = f"{voxels} voxels, about {in_gigabytes(smoothed)}"
        remedy = f"{remedies['vol_geom']}, or device='cpu'"
        raise fail("vol_geom", expected, got, remedy, MemoryError)


@dataclass(frozen=True)
class StepSize:
    """What the memory of a step goes with.

    Attributes
    ----------
    gaussians : int
        Of a run.
    views, pixels : int
        Of a step, and of a view, in all runs.
    voxels : int
    runs : int
        That there are at once.
    """

    gaussians: int
    views: int
    pixels: int
    voxels: int
    runs: int = 1


def step_bytes(device: torch.device, size: StepSize) -> dict[str, int]:
    """Bytes that the steps of a fit take on a device, by what takes them."""
    return {"Gaussians": _of_gaussians(size, device)} | _of_all(size, device)


def has_room(device: torch.device, size: StepSize) -> bool:
    """Whether a CUDA device has the memory that `step_bytes` tells; others are not asked."""
    return device.type == "cpu" or sum(step_bytes(device, size).values()) <= _SHARE * free_bytes(device)


def require_room(device: torch.device, size: StepSize, projections: int) -> str:
    """The estimate in words.

    Parameters
    ----------
    device : torch.device
    size : StepSize
    projections : int
        Bytes of them on the device already; 0 where they stay on the host.

    Raises
    ------
    ValueError
        If a CUDA device has too little memory left.
    MemoryError
        If the host has too little memory left for the Gaussians of a fit on a CPU.
    """
    parts = step_bytes(device, size)
    need = sum(parts.values())
    words = ", ".join(f"{name} {in_gigabytes(taken)}" for name, taken in parts.items())
    words = f"about {in_gigabytes(need)} ({words})"
    if device.type == "cpu":
        # The volumes are there in part already.
        cloud = {"settings": (words, float(need - parts["volumes"]))}
        remedy = "lower max_gaussians or views_per_step, bin the detector's pixels, or take fewer voxels"
        require_memory(cloud, {"settings": remedy})
        there = available_memory()
        if there is not None and need > there:
            logger.warning("Memory: %s, and %s are free.", words, in_gigabytes(there))
        return words
    free = free_bytes(device)
    where = f"on the GPU, {in_gigabytes(projections)}" if projections else "streamed from the host"
    if need > _SHARE * free:
        remedy = "lower settings max_gaussians or views_per_step, take fewer voxels, or device='cpu'"
        if size.runs > 1:
            remedy = f"say settings pixel_rays and light, which saves a second run beside the first, {remedy}"
        raise fail("device", f"a GPU with {words} free", f"{in_gigabytes(free)} on {device}", remedy)
    words = f"{words} of {in_gigabytes(free)} free; projections {where}"
    logger.debug("Memory: %s.", words)
    return words


def room_for_gaussians(device: torch.device, size: StepSize) -> float:
    """How many Gaussians of a run there is memory for, on a CPU too; infinity where nobody tells how much is free.

    Those of the ``size`` do not count.
    """
    views, runs = size.views, size.runs
    free = available_memory() if device.type == "cpu" else free_bytes(device)
    if free is None:
        return math.inf
    left = max(_SHARE * free - sum(_of_all(size, device).values()), 0.0)
    if device.type == "cpu":
        return left / (runs * _of_a_gaussian(views))
    ranks = current_ranks().count
    few = left / (runs * ((_WHOLE if ranks > 1 else 0) + _of_a_gaussian(views) / ranks))
    portion = FOOTPRINTS / views
    if few <= portion * ranks:
        return few
    return (left / runs - portion * (_PASSING + _FOOTPRINT * views)) / _that_stays()


@contextmanager
def told_of_lack() -> Iterator[None]:
    """Torch's word that a GPU is full, as an error that says what to do.

    Raises
    ------
    MemoryError
        In its place.
    """
    try:
        yield
    except torch.cuda.OutOfMemoryError as full:
        got = f"{full}".strip() or "no room"
        remedy = (
            "lower settings max_gaussians or views_per_step, take fewer or larger voxels, end what else uses the GPU,"
            ' let the plan count on less of it (settings={"memory": "..."}), or device=\'cpu\''
        )
        raise fail("device", "a GPU with room for the fit", got, remedy, MemoryError) from full


def _of_gaussians(size: StepSize, device: torch.device) -> int:
    """Bytes of the Gaussians of all runs, on the first rank."""
    if device.type == "cpu":
        return math.ceil(size.runs * size.gaussians * _of_a_gaussian(size.views))
    portion = min(size.gaussians / current_ranks().count, FOOTPRINTS / size.views)
    passing = portion * (_PASSING + _FOOTPRINT * size.views)
    return math.ceil(size.runs * (size.gaussians * _that_stays() + passing))


def _that_stays() -> float:
    """Bytes of a Gaussian that the first rank's GPU holds from step to step."""
    ranks = current_ranks().count
    return (_WHOLE if ranks > 1 else 0) + _GAUSSIAN / ranks


def _of_a_gaussian(views: int) -> float:
    """Bytes of a Gaussian of which all is held at once."""
    return _GAUSSIAN + _PASSING + _FOOTPRINT * views


def _of_all(size: StepSize, device: torch.device) -> dict[str, int]:
    """Bytes that a fit takes whatever the number of Gaussians."""
    # On a CPU runs take turns and keep nothing of a step.
    times = 1 if device.type == "cpu" else size.runs
    return {
        "images of a step": size.views * size.pixels * _PIXEL,
        "volumes": times * size.voxels * _SMOOTHED[device.type] + min(_SAMPLES, 27 * 12 * size.voxels),
    }

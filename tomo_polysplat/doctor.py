"""What is installed, what the machine has, which kernels it can run, and whether it all works together."""

from __future__ import annotations

import importlib
import platform
import shutil
import subprocess
import time
from dataclasses import replace
from importlib.util import find_spec

import tomo_polysplat
from tomo_polysplat.free_memory import available_memory
from tomo_polysplat.parallel import cpu_threads
from tomo_polysplat.versions import installed_version

__all__ = ["findings", "self_test", "warm"]

Lines = list[tuple[str, str]]

PACKAGES = {
    "numpy": "",
    "scipy": "",
    "torch": "",
    "numba": "",
    "astra-toolbox": "",
    "xraydb": "",
    "scikit-image": "",
    "h5py": "",
    "matplotlib": "",
    "triton": "(only an NVIDIA GPU needs it; CUDA builds of torch bring it)",
}
TOMOPY_SOURCE = "optional; from conda-forge: conda install -c conda-forge tomopy"
DXCHANGE_SOURCE = "optional; from conda-forge: conda install -c conda-forge dxchange"


def findings() -> list[tuple[str, Lines]]:
    """Headings, each with lines of (name, text)."""
    return [
        (
            "versions",
            [
                ("tomo-polysplat", tomo_polysplat.__version__),
                ("python", platform.python_version()),
                *_packages(),
            ],
        ),
        ("machine", _machine()),
        ("ASTRA", _astra()),
        ("kernels", _kernels()),
    ]


def self_test() -> tuple[bool, str]:
    """Simulate a small scan with metal, reconstruct it, and compare with the truth.

    Returns
    -------
    passed : bool
        Whether the error came below that of plain filtered backprojection.
    text : str
        What was measured, or what went wrong.
    """
    from tomo_polysplat.result.metrics import compare
    from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
    from tomo_polysplat.simulate.scenes import simulate_scan
    from tomo_polysplat.start.fdk import fdk

    started = time.perf_counter()
    try:
        scan = simulate_scan("pins", size=24, views=48)
        projections = projections_from_astra(scan.projections, scan.proj_geom)
        plain = fdk(projections, *from_astra(scan.proj_geom, scan.vol_geom))
        result = tomo_polysplat.reconstruct(
            scan.projections,
            scan.proj_geom,
            scan.vol_geom,
            spectrum=scan.spectrum,
            unit=scan.unit,
            quality="fast",
        )
        assert scan.truth is not None  # a simulated scan has one
        ours = compare(result.volume, scan.truth, scan.metal_mask)["psnr"]
        standard = compare(plain, scan.truth, scan.metal_mask)["psnr"]
    except Exception as error:  # whatever is broken on this machine is the finding
        return False, f"{type(error).__name__}: {error}"
    seconds = time.perf_counter() - started
    return ours > standard, f"24^3 voxels: {ours:.1f} dB, FDK {standard:.1f} dB, {seconds:.1f} s in all"


def warm() -> str:
    """Compile the kernels of all kinds of scans, which stay on disk, so that no later run on this machine has to.

    Returns
    -------
    str
        How long compiling took, and all of it.
    """
    from tomo_polysplat.kernels.compile_time import compiled_seconds, track_compiling
    from tomo_polysplat.simulate.scenes import simulate_scan

    track_compiling()
    started, before = time.perf_counter(), compiled_seconds()
    for geometry in ("cone", "parallel", "fan"):
        metal, plain = (
            simulate_scan("pins", 16, 48, metal=there, geometry=geometry) for there in (True, False)
        )
        # Three images and averaged light or thin rays, one image under a spectrum, and one without.
        kinds = ((metal, 2), (metal, 1), (plain, 1), (replace(plain, spectrum=None), 1))
        for scan, rays in kinds:
            settings = {"passes": 2.0, "pixel_rays": rays}
            tomo_polysplat.reconstruct(scan, settings=settings, progress=False)
    compiling, whole = compiled_seconds() - before, time.perf_counter() - started
    return f"{compiling:.1f} s of compiling, {whole:.1f} s in all"


def _packages() -> Lines:
    lines = [
        (name, installed_version(name) or f"not installed {hint}".rstrip()) for name, hint in PACKAGES.items()
    ]
    return [*lines, ("tomopy", _tomopy()), ("dxchange", _dxchange())]


def _tomopy() -> str:
    if find_spec("tomopy") is None:
        return f"not installed ({TOMOPY_SOURCE})"
    try:
        importlib.import_module("tomopy")
    except Exception as error:  # its compiled libraries may be missing, or want another NumPy
        return f"cannot be imported ({error}); {TOMOPY_SOURCE}"
    return installed_version("tomopy") or "installed"


def _dxchange() -> str:
    """Tell the tomography package apart from the unrelated one of that name on PyPI."""
    if find_spec("dxchange") is None:
        return f"not installed ({DXCHANGE_SOURCE})"
    try:
        module = importlib.import_module("dxchange")
    except Exception as error:  # a stranger's module may fail in any way when imported
        return f"cannot be imported ({error})"
    if hasattr(module, "read_aps_tomoscan_hdf5"):
        return installed_version("dxchange") or "installed"
    return f"an unrelated package of that name; remove it ({DXCHANGE_SOURCE})"


def _machine() -> Lines:
    import torch

    memory = available_memory()
    lines = [
        ("system", platform.platform()),
        ("CPU threads", str(cpu_threads())),
        ("free memory", "unknown" if memory is None else f"{memory / 2**30:.1f} GiB"),
    ]
    if not torch.cuda.is_available():
        built = torch.version.cuda or "no CUDA"
        return [*lines, ("GPU", f"none that torch can use (torch is built with {built})")]
    for index in range(torch.cuda.device_count()):
        free, total = torch.cuda.mem_get_info(index)
        name = torch.cuda.get_device_name(index)
        lines.append((f"GPU {index}", f"{name}, {free / 2**30:.1f} of {total / 2**30:.1f} GiB free"))
    return [*lines, ("CUDA", f"{torch.version.cuda} in torch, driver {_driver()}")]


def _driver() -> str:
    tool = shutil.which("nvidia-smi")
    if tool is None:
        return "unknown"
    query = [tool, "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(query, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return answer.stdout.strip().splitlines()[0] if answer.stdout.strip() else "unknown"


def _astra() -> Lines:
    try:
        import astra
    except Exception as error:  # a broken shared library can raise anything
        return [("astra", f"cannot be imported ({error})")]
    # Asking ASTRA to run on a GPU that it cannot use would end the process, so this is only asked about.
    return [("CUDA", "usable" if astra.use_cuda() else "not usable: its CPU algorithms and ours are used")]


def _kernels() -> Lines:
    try:
        from tomo_polysplat.kernels.select import describe

        return [
            (f"{name} ({device})", f"{'usable' if usable else 'not usable'}: {reason}")
            for name, device, usable, reason in describe()
        ]
    except Exception as error:  # a broken compiler or driver is the finding
        return [("kernels", f"cannot be examined ({type(error).__name__}: {error})")]

"""What TomoPy does with an algorithm, written from its documentation, for machines that do not have TomoPy.

``recon`` hands sinograms, centres and images to the algorithm in chunks of slices, over threads, and returns the
images; what the algorithm returns is ignored.
"""

import math
import os
import sys
from concurrent.futures import ThreadPoolExecutor, wait
from importlib.machinery import ModuleSpec
from types import ModuleType

import numpy as np


def install(monkeypatch):
    """Put the stand-in where ``import tomopy`` finds it, and return it."""
    names = ("tomopy", "tomopy.recon", "tomopy.recon.algorithm", "tomopy.util", "tomopy.util.extern")
    modules = {name: ModuleType(name) for name in names}
    for name, module in modules.items():
        module.__spec__, module.__path__ = ModuleSpec(name, None, is_package=True), []
        monkeypatch.setitem(sys.modules, name, module)
    algorithm, extern = modules["tomopy.recon.algorithm"], modules["tomopy.util.extern"]
    algorithm.allowed_recon_kwargs = {"gridrec": ["num_gridx", "num_gridy", "filter_name", "filter_par"]}
    tomopy = modules["tomopy"]
    tomopy.recon = lambda *args, **keywords: _recon(algorithm, extern, *args, **keywords)
    return tomopy


def _recon(
    module,
    extern,
    tomo,
    theta,
    center=None,
    sinogram_order=False,
    algorithm=None,
    init_recon=None,
    ncore=None,
    nchunk=None,
    **keywords,
):
    tomo = np.asarray(tomo, np.float32)
    tomo = np.require(tomo if sinogram_order else tomo.swapaxes(0, 1), requirements="AC")
    slices, views, columns = tomo.shape
    if views != len(theta):
        raise ValueError("There must be one angle for every projection.")
    defaults = {"num_gridx": columns, "num_gridy": columns, "options": {}}
    if isinstance(algorithm, str):
        allowed = module.allowed_recon_kwargs[algorithm]
        unknown = set(keywords) - set(allowed)
        if unknown:
            raise ValueError(f"{unknown} keyword not in allowed keywords {allowed}")
        keywords = {name: np.array(value) for name, value in keywords.items()}
        defaults = {name: defaults[name] for name in allowed}
        algorithm = getattr(extern, f"c_{algorithm}")
    keywords = defaults | keywords
    if center is None or np.size(center) == 1:
        center = np.ones(slices, np.float32) * np.float32(columns / 2 if center is None else center)
    center = np.asarray(center, np.float32)
    if len(center) != slices:
        raise ValueError("There must be one center for every slice.")
    if init_recon is None:
        recon = np.full((slices, int(keywords["num_gridx"]), int(keywords["num_gridy"])), 1e-6, np.float32)
    else:
        recon = np.require(init_recon, np.float32, "AC")
    ncore, parts = _chunks(slices, ncore, nchunk)
    theta = np.asarray(theta, np.float32)
    if ncore == 1:
        for part in parts:
            algorithm(tomo[part], center[part], recon[part], theta, **keywords)
        return recon
    with ThreadPoolExecutor(ncore) as pool:
        futures = [
            pool.submit(algorithm, tomo[part], center[part], recon[part], theta, **keywords) for part in parts
        ]
    for future in wait(futures).done:
        if future.exception() is not None:
            raise future.exception()
    return recon


def _chunks(slices, ncore, nchunk):
    """Number of threads and the indices of every chunk; chunks of 0 lose their axis."""
    ncore = min(ncore or os.cpu_count(), slices)
    if nchunk == 0:
        return ncore, list(range(slices))
    edges = np.linspace(0, slices, ncore + 1).round().astype(int) if nchunk is None else None
    if edges is None:
        edges = np.minimum(np.arange(math.ceil(slices / nchunk) + 1) * nchunk, slices)
    return min(ncore, len(edges) - 1), [slice(a, b) for a, b in zip(edges[:-1], edges[1:])]

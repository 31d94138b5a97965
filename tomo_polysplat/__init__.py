"""CT reconstruction of scans with metal and beam hardening, by Gaussians under the spectrum of the tube.

The names below are the public interface; each is imported when first used, so that importing the package
is quick and loads neither a GPU stack nor a compiler.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any

from tomo_polysplat.quiet_imports import leaving_no_trace

__version__ = "0.1.0"

_PUBLIC = {
    "Counts": "tomo_polysplat.scan.counts",
    "Detector": "tomo_polysplat.physics.detector",
    "Materials": "tomo_polysplat.physics.base_materials",
    "Result": "tomo_polysplat.result.result",
    "Scan": "tomo_polysplat.scan.scan",
    "Spectrum": "tomo_polysplat.physics.spectrum",
    "cone_geometry": "tomo_polysplat.scan.circular",
    "compare": "tomo_polysplat.baselines.comparison",
    "contrast": "tomo_polysplat.quality.inserts",
    "load_scan": "tomo_polysplat.scan.io",
    "parallel_geometry": "tomo_polysplat.scan.circular",
    "polysplat": "tomo_polysplat.plugins.tomopy_plugin",
    "reconstruct": "tomo_polysplat.reconstruction",
    "register": "tomo_polysplat.plugins.hosts",
    "resolution": "tomo_polysplat.quality.halves",
    "save_scan": "tomo_polysplat.scan.io",
    "simulate_scan": "tomo_polysplat.simulate.scenes",
}

# Parts that are public as a whole.
_PARTS = ("baselines",)
# What sets warning filters as it loads, which is else during the first call of a function.
_SET_FILTERS = ("scipy.sparse", "scipy.special")

__all__ = ["__version__", *sorted([*_PUBLIC, *_PARTS])]


def __getattr__(name: str) -> Any:
    if name in _PUBLIC:
        with leaving_no_trace():
            value = getattr(import_module(_PUBLIC[name]), name)
            for other in _SET_FILTERS:
                import_module(other)
        globals()[name] = value
        return value
    if name in _PARTS:
        return import_module(f"{__name__}.{name}")
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

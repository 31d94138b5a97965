"""ASTRA: the algorithm ``POLYSPLAT``, for ``astra.astra_dict("POLYSPLAT")`` after ``tomo_polysplat.register()``.

Geometries come from the data objects; no projector is needed. ASTRA passes options as text, which only numbers
survive: anything else travels in one :class:`AstraOptions`.
"""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Callable, Mapping
from functools import cache, wraps
from typing import Any

import numpy as np

import tomo_polysplat
from tomo_polysplat.checks import fail, require_choice
from tomo_polysplat.plugins.host_options import solver_options

__all__ = ["NAME", "AstraOptions", "guarded_create", "plugin_class"]

NAME = "POLYSPLAT"
NUMBERS = ("Seed", "TimeBudget", "Passes", "TubeVoltage")
OWN_OPTIONS = ("valid", "projections", "reconstruction")

_numbers = itertools.count(1)
_living: weakref.WeakValueDictionary[int, AstraOptions] = weakref.WeakValueDictionary()


class AstraOptions:
    """What ASTRA's options cannot carry: ``cfg["option"] = {"Options": AstraOptions(...)}``.

    Parameters
    ----------
    **options
        Keywords of :func:`tomo_polysplat.reconstruct` (``spectrum``, ``materials``, ``unit``, ``quality``,
        ``valid``, ...), or ``kvp`` with ``filters``, ``anode`` and ``detector`` for the spectrum. For data that
        ASTRA keeps on a GPU and cannot hand out: the linked tensors as ``projections`` and ``reconstruction``.

    Raises
    ------
    ValueError, TypeError
        For an unknown name, or a spectrum described twice or in part.
    """

    def __init__(self, **options: Any) -> None:
        own, solver = solver_options(options, OWN_OPTIONS)
        self.options = own | solver
        self.number = next(_numbers)
        _living[self.number] = self

    def __str__(self) -> str:
        """The number by which it is found again; this is all of it that ASTRA sees."""
        return str(self.number)


def _options_numbered(number: float) -> dict[str, Any]:
    if int(number) in _living:
        return _living[int(number)].options
    raise fail("Options", "an AstraOptions that is still kept by the caller", f"{number:g}")


@cache
def plugin_class() -> type:
    """The class that ASTRA makes an object of for every ``astra.algorithm.create``."""
    import astra

    class PolySplat(astra.plugin.base):
        """Polychromatic reconstruction with Gaussians, for scans with metal and beam hardening.

        ``astra.algorithm.run(id, n)`` uses every view n times; 0 or 1, what ASTRA passes when told nothing,
        leaves that to the quality. ``astra.algorithm.get_plugin_object(id).result`` is the ``Result``.
        """

        astra_name = NAME

        # ASTRA reads the names and defaults of the options off this signature.
        def initialize(self, cfg, Options=0, Seed=0, TimeBudget=0, Passes=0, TubeVoltage=0):  # noqa: N803
            numbers = {"seed": int(Seed), "time_budget": TimeBudget, "kvp": TubeVoltage}
            stated = {name: value for name, value in numbers.items() if value}
            kept = _options_numbered(Options) if Options else {}
            self.own, self.solver = solver_options(kept | stated, OWN_OPTIONS)
            self.passes = Passes
            self.data = {name: cfg[f"{name}DataId"] for name in ("Projection", "Reconstruction")}
            self.result = None

        def run(self, iterations):
            options = self.solver | {"valid": self.own.get("valid")}
            if passes := iterations if iterations > 1 else self.passes:
                settings = options.get("settings") or {}
                settings = getattr(settings, "to_dict", lambda known=settings: dict(known))()
                options["settings"] = settings | {"passes": float(passes)}
            projections, proj_geom = _data(self.data["Projection"], self.own.get("projections"))
            volume, vol_geom = _data(self.data["Reconstruction"], self.own.get("reconstruction"))
            if hasattr(projections, "detach"):
                projections = projections.detach().cpu().numpy()
            self.result = tomo_polysplat.reconstruct(projections, proj_geom, vol_geom, **options)
            _write(volume, self.result.volume)

    return PolySplat


def _data(number: int, tensor: Any) -> tuple[Any, dict[str, Any]]:
    """Memory and geometry of a data object; `tensor` is the memory where ASTRA cannot hand it out."""
    import astra

    try:
        kind, geometry = astra.data3d, astra.data3d.get_geometry(number)
    except Exception:  # ASTRA numbers 2D and 3D data together and says only by failing which one it is
        kind, geometry = astra.data2d, astra.data2d.get_geometry(number)
    # ASTRA keeps the window in float32; the shortest decimal is what the caller wrote, unless it was longer.
    window = geometry.get("options", {})
    window.update({name: float(str(np.float32(value))) for name, value in window.items()})
    try:
        return kind.get_shared(number) if tensor is None else tensor, geometry
    except Exception as error:
        remedy = 'pass the tensors: option={"Options": AstraOptions(projections=..., reconstruction=...)}'
        raise fail("data", "memory that ASTRA can hand out", str(error), remedy) from None


def _write(target: Any, volume: np.ndarray) -> None:
    if hasattr(target, "detach"):
        import torch

        target[...] = torch.from_numpy(np.ascontiguousarray(volume))
    else:
        target[...] = volume


def guarded_create(create: Callable[[Mapping[str, Any]], int]) -> Callable[[Mapping[str, Any]], int]:
    """``astra.algorithm.create`` that refuses options on which ASTRA would abort the process or drop others."""

    @wraps(create)
    def checked(config: Mapping[str, Any]) -> int:
        if config.get("type") == NAME:
            _require_safe_options(config.get("option", config.get("options", {})))
        return create(config)

    return checked


def _require_safe_options(options: Mapping[str, Any]) -> None:
    for name, value in options.items():
        require_choice("option", name, ("Options", *NUMBERS), "the rest goes into Options: AstraOptions(...)")
        wanted = AstraOptions if name == "Options" else (int, float, np.integer, np.floating)
        if not isinstance(value, wanted):
            expected = "an AstraOptions" if name == "Options" else "a number"
            raise fail(f"option['{name}']", expected, repr(value), error=TypeError)

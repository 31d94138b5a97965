"""Options that a host hands through in a dict, checked by name."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from tomo_polysplat.checks import fail, require_choice

__all__ = ["SOLVER_OPTIONS", "solver_options", "spectrum_of", "split_options"]

TUBE_OPTIONS = ("kvp", "anode", "filters", "detector")
PASSED_ON = (
    *("spectrum", "materials", "unit", "quality", "time_budget", "seed", "device", "devices"),
    *("callbacks", "progress", "settings", "water_correction", "checkpoint", "resume"),
    *("calibrate", "soft_density", "align"),
)
SOLVER_OPTIONS = (*PASSED_ON, *TUBE_OPTIONS)


def solver_options(
    options: Mapping[str, Any], own_names: Iterable[str]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Split a host's options into the adapter's own and the keywords of ``tomo_polysplat.reconstruct``.

    Parameters
    ----------
    options : mapping
        Not modified. ``kvp`` with ``anode``, ``filters`` (cm by material) and ``detector`` describes a
        spectrum.
    own_names : iterable of str
        Options that the adapter itself understands.

    Raises
    ------
    ValueError, TypeError
        For an unknown name, or a spectrum described twice or in part.
    """
    own, solver, tube = split_options(options, own_names)
    return own, solver | spectrum_of(tube)


def split_options(
    options: Mapping[str, Any], own_names: Iterable[str]
) -> tuple[dict[str, Any], dict[str, Any], dict[str, Any]]:
    """The adapter's own options, the solver's, and those of a tube, of which no spectrum is made yet.

    Parameters and errors are those of :func:`solver_options`.
    """
    if not isinstance(options, Mapping):
        raise fail("options", "a dict", repr(type(options).__name__), error=TypeError)
    own_names = tuple(own_names)
    for name in options:
        require_choice("options", name, sorted((*own_names, *SOLVER_OPTIONS)))
    own = {name: options[name] for name in own_names if name in options}
    solver = {name: options[name] for name in PASSED_ON if name in options}
    tube = {name: options[name] for name in TUBE_OPTIONS if options.get(name) is not None}
    if tube and "kvp" not in tube:
        raise fail("options['kvp']", f"the tube voltage beside {', '.join(tube)}", "none")
    if tube and solver.get("spectrum") is not None:
        raise fail("options['spectrum']", "none beside kvp", "both", "give one of them")
    return own, solver, tube


def spectrum_of(tube: Mapping[str, Any]) -> dict[str, Any]:
    """The keyword ``spectrum`` of a tube's options; nothing without a tube."""
    if not tube:
        return {}
    from tomo_polysplat.physics.spectrum import Spectrum

    return {"spectrum": Spectrum.from_tube(**tube)}

"""Make the reconstruction known to the host programs that are installed."""

from __future__ import annotations

import importlib
import logging
from importlib.util import find_spec

__all__ = ["register"]

logger = logging.getLogger(__name__)


def register() -> tuple[str, ...]:
    """Make ``algorithm="polysplat"`` known to TomoPy and ``astra.astra_dict("POLYSPLAT")`` to ASTRA.

    It lasts as long as the process and may be repeated. Whichever host is missing is left out; one that is there
    but cannot be imported is left out with a warning.

    Returns
    -------
    tuple of str
        The hosts that know it now: ``"astra"``, ``"tomopy"``.

    Notes
    -----
    ASTRA gets a check in front of ``astra.algorithm.create`` that concerns this algorithm's options only: some
    would abort the process before any of our code runs.
    """
    known = []
    for name, tell in (("astra", _tell_astra), ("tomopy", _tell_tomopy)):
        if find_spec(name) is None:
            logger.info("%s is not installed", name)
            continue
        try:
            tell()
        except (ImportError, OSError) as error:
            logger.warning("%s is installed but cannot be imported: %s", name, error)
            continue
        known.append(name)
    return tuple(known)


def _tell_astra() -> None:
    import astra

    from tomo_polysplat.plugins.astra_plugin import NAME, guarded_create, plugin_class

    if NAME not in astra.plugin.get_registered():
        astra.plugin.register(plugin_class())
        astra.algorithm.create = guarded_create(astra.algorithm.create)


def _tell_tomopy() -> None:
    from tomo_polysplat.plugins.tomopy_plugin import polysplat

    # `tomopy.recon` is the function, which hides the package of that name.
    algorithms = importlib.import_module("tomopy.recon.algorithm")
    vars(importlib.import_module("tomopy.util.extern"))["c_polysplat"] = polysplat
    algorithms.allowed_recon_kwargs["polysplat"] = ["num_gridx", "num_gridy", "options"]

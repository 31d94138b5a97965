"""The usual methods, to compare with: each takes a scan and returns a result, as `tomo_polysplat.reconstruct` does.

    fdk = tps.baselines.fdk(scan)
    print(tps.compare(scan.truth, {"FDK": fdk, "tomo-polysplat": result}, metal=scan.metal_mask))

The algorithms themselves, of arrays, lie in `tomo_polysplat.baselines.arrays`, one a file.
"""

from __future__ import annotations

from typing import Any

__all__ = ["fdk", "limar", "nmar", "sirt", "water_bhc"]


def __getattr__(name: str) -> Any:
    if name in __all__:
        from tomo_polysplat.baselines import of_scan

        return getattr(of_scan, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)

"""Was the logarithm taken?"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.probes.measured import Finding, Measured

__all__ = ["probe_logarithm"]

# Share of the columns at either end that are taken for air.
_BORDER = 0.04


def probe_logarithm(measured: Measured) -> Finding:
    """Tell -log(I/I0) from I/I0 and from counts: an object adds to the first and takes away from the others."""
    values = measured.filled
    width = max(1, int(_BORDER * values.shape[2]))
    air = float(np.median(np.concatenate([values[..., :width], values[..., -width:]], axis=2)))
    low, high = np.percentile(values, [1, 99])
    below, above = air - float(low), float(high) - air
    numbers = {"air": air, "below": below, "above": above}
    if below <= 2 * above:
        return Finding("logarithm", "ok", f"taken: the object adds up to {above:.3g} to the air", "", numbers)
    if air > 30:
        text, remedy = "the values are counts", "give the open-beam images, or pass -log(I / I0)"
    elif air > 0.3:
        text, remedy = (
            "not taken: the values are transmissions I/I0",
            "pass -log of them, or input='transmission'",
        )
    else:
        text, remedy = (
            "the sign is turned: the object lowers the values below those of air",
            "pass -log(I / I0)",
        )
    return Finding("logarithm", "defect", f"{text} (air {air:.3g}, object {float(low):.3g})", remedy, numbers)

"""Was the logarithm taken?"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.probes.measured import Finding, Measured

__all__ = ["COUNTS", "REMEDIES", "SIGN", "TRANSMISSIONS", "probe_logarithm"]

# Share of the columns at either end that are taken for air.
_BORDER = 0.04

COUNTS, TRANSMISSIONS, SIGN = "counts", "transmissions I/I0", "logarithms of the other sign"
REMEDIES = {
    COUNTS: "give the open-beam images, or pass -log(I / I0)",
    TRANSMISSIONS: "pass -log of them, or input='transmission' where a file or TomoPy's options say what they are",
    SIGN: "pass -log(I / I0)",
}


def probe_logarithm(measured: Measured) -> Finding:
    """Tell -log(I/I0) from I/I0 and from counts: an object raises the first and lowers the others."""
    values = measured.filled
    width = max(1, int(_BORDER * values.shape[2]))
    air = float(np.median(np.concatenate([values[..., :width], values[..., -width:]], axis=2)))
    low, high = np.percentile(values, [1, 99])
    below, above = air - float(low), float(high) - air
    numbers = {"air": air, "below": below, "above": above}
    if below <= 2 * above:
        return Finding("logarithm", "ok", f"taken: the object adds up to {above:.3g} to the air", "", numbers)
    if air > 30:
        kind, text = COUNTS, "the values are counts"
    elif air > 0.3:
        kind, text = TRANSMISSIONS, "not taken: the values are transmissions I/I0"
    else:
        kind, text = SIGN, "the sign is turned: the object lowers the values below those of air"
    text = f"{text} (air {air:.3g}, object {float(low):.3g})"
    return Finding("logarithm", "defect", text, REMEDIES[kind], numbers)

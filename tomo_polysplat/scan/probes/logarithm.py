"""Was the logarithm taken?"""

from __future__ import annotations

import numpy as np

from tomo_polysplat.scan.probes.finding import DEFECT, OK, UNKNOWN, Finding
from tomo_polysplat.scan.probes.measured import Measured

__all__ = ["COUNTS", "LOGARITHM", "REMEDIES", "SIGN", "TRANSMISSIONS", "probe_logarithm"]

LOGARITHM = "logarithm"
COUNTS, TRANSMISSIONS, SIGN = "counts", "transmissions I/I0", "logarithms of the other sign"
REMEDIES = {
    COUNTS: "give the open-beam images, or pass -log(I / I0)",
    TRANSMISSIONS: "pass -log of them, or input='transmission' where a file or TomoPy's options say what they are",
    SIGN: "pass -log(I / I0)",
}
# Half of the rays beyond this are darker than e^-100, and no logarithms.
_COUNTS = 30.0
# Transmissions lie between these, and turned logarithms below the first.
_LOWEST, _HIGHEST = -0.05, 1.2
_BORDER = 0.04


def probe_logarithm(measured: Measured) -> Finding:
    """Tell -log(I/I0) from I/I0 and from counts: an object adds to the first and takes away from the others."""
    values = measured.filled
    low, high = (float(value) for value in np.percentile(values, [1, 99]))
    width = max(1, int(_BORDER * values.shape[2]))
    beside = float(np.median(np.concatenate([values[..., :width], values[..., -width:]], axis=2)))
    below, above = beside - low, high - beside
    numbers = {"air": beside, "below": below, "above": above}
    if beside > _COUNTS or high > _COUNTS:
        kind, text = COUNTS, "the values are counts, or logarithms times a large number"
    elif below <= 2 * above:
        if measured.air is None and low > _LOWEST and high < _HIGHEST:
            text = "no air beside the object to tell logarithms from transmissions by"
            return Finding(LOGARITHM, UNKNOWN, text, "a wider view, or an air scan", numbers)
        return Finding(LOGARITHM, OK, f"taken: the object adds up to {above:.3g} to the air", "", numbers)
    elif measured.air is None:
        # A view from within a hollow object also has less in its middle than at its ends.
        text = f"the rays at the ends ({beside:.3g}) hold more than those in the middle, but are not as flat as air"
        return Finding(LOGARITHM, UNKNOWN, text, "a view of air beside the object", numbers)
    elif beside > 0.3:
        kind, text = TRANSMISSIONS, "not taken: the values are transmissions I/I0"
    else:
        kind, text = SIGN, "the sign is turned: the object lowers the values below those of air"
    text = f"{text} (air {beside:.3g}, object {low:.3g})"
    return Finding(LOGARITHM, DEFECT, text, REMEDIES[kind], numbers)

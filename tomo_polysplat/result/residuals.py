"""How well the rays are explained, by view and by pixel: what ``Result.explain`` finds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

__all__ = ["Residuals"]


@dataclass(frozen=True, eq=False)
class Residuals:
    """What the model says of the rays, less what was measured.

    Attributes
    ----------
    views : (n,) int array
        The views looked at.
    by_view : (n,) array
        Root mean square of the residuals of each, in units of noise; NaN where no ray of it is usable.
    by_pixel : (rows, columns) array
        The same of each pixel over the views; blocks of pixels where there are many, NaN where none is usable.
    bias : (rows, columns) array
        Mean residual, model less measurement, in units of noise: what noise alone would average out.
    held_out : (n,) array
        As `by_view`, of the rays alone that the fit has not seen; NaN where there are none.
    rms, within : float
        Root mean square over all rays, and the share of them that is off by less than three deviations.
    rms_held_out : float
        That over the rays the fit has not seen; NaN where there are none.
    rays : int
        Usable rays looked at.
    photons : float
        Of an unattenuated ray, from which the noise follows; infinity where it does not.
    worst : (3,) array
        Where in the volume the rays meet that are explained worst, (x, y, z); see ``report.where``.
    worst_value, usual_value : float
        Root mean square of the rays through there, and through the middling point of the volume.
    block : int
        Pixels along an edge of a block of the maps.
    deviation : float
        Of the noise, where it is as strong in every ray. Without this and photons the data shows no noise, and
        residuals are those of -log(I/I0) themselves.
    """

    views: np.ndarray
    by_view: np.ndarray
    by_pixel: np.ndarray
    bias: np.ndarray
    held_out: np.ndarray
    rms: float
    within: float
    rms_held_out: float
    rays: int
    photons: float
    worst: np.ndarray
    worst_value: float
    usual_value: float
    block: int = 1
    deviation: float = 0.0

    @property
    def unit(self) -> str:
        """What the numbers are in."""
        return "deviations of the noise" if self.noisy else "units of -log(I/I0)"

    @property
    def noisy(self) -> bool:
        """Whether the data shows noise."""
        return bool(np.isfinite(self.photons)) or self.deviation > 0

"""Structural similarity of projections, the paper's optional term."""

from __future__ import annotations

import torch

__all__ = ["dissimilarity"]

_WINDOW = 7


def dissimilarity(predicted: torch.Tensor, measured: torch.Tensor, usable: torch.Tensor) -> torch.Tensor:
    r"""``1 - SSIM`` of projections (Wang et al. 2004, doi:10.1109/TIP.2003.819861), mean over views and pixels.

    Parameters
    ----------
    predicted, measured : (views, rows, columns) tensor
        -log(I/I0).
    usable : (views, rows, columns) tensor
        0 for rays that must not count: there the measurement is replaced by the prediction.

    Returns
    -------
    scalar tensor
        0 for equal images; means over 7 x 7 pixels (1 x 7 for one detector row), range = the largest value.
    """
    measured = torch.where(usable > 0, measured, predicted.detach())
    span = measured.amax().clamp(min=1e-6)
    window = tuple(min(_WINDOW, n) for n in predicted.shape[1:])

    def mean(image: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.avg_pool2d(image[:, None], window, stride=1)[:, 0]

    p, m = mean(predicted), mean(measured)
    variance_p, variance_m = mean(predicted.square()) - p.square(), mean(measured.square()) - m.square()
    covariance = mean(predicted * measured) - p * m
    c1, c2 = (0.01 * span).square(), (0.03 * span).square()
    luminance = (2 * p * m + c1) / (p.square() + m.square() + c1)
    structure = (2 * covariance + c2) / (variance_p + variance_m + c2)
    return 1 - (luminance * structure).mean()

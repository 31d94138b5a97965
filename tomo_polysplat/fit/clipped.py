"""Residuals of rays, of which those far off count as less far ones."""

from __future__ import annotations

import torch

from tomo_polysplat.settings import Settings

__all__ = ["allowed_error", "clipped", "usual_error"]

# Residuals beyond so many deviations count as so many.
_FAR = 4.0
# A model is allowed at least this error of -log(I/I0): without any, a scan without noise would have only far rays.
_LEAST_ERROR = 1e-3


def allowed_error(settings: Settings) -> float:
    """Error of -log(I/I0) that a model is allowed in a ray of weight 1."""
    return max(settings.model_error, _LEAST_ERROR)


def usual_error(residual: torch.Tensor, fitted: torch.Tensor, allowed: float) -> torch.Tensor:
    """Root mean square of residuals times their weights ``fitted``, at least what is ``allowed``."""
    used = (fitted > 0).to(residual.dtype)
    return ((residual * fitted).square().sum() / used.sum().clamp(min=1)).sqrt().clamp(min=allowed)


def clipped(residual: torch.Tensor, fitted: torch.Tensor, error: float | torch.Tensor) -> torch.Tensor:
    """Residuals of at most so many deviations, which are an error over the rays' weights ``fitted``."""
    far = _FAR * error / fitted.clamp(min=1e-12)
    return residual.maximum(-far).minimum(far)

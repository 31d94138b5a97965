"""Whether the held-out rays tell the truth: what the stopping rule keeps against the best there was."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tomo_polysplat.fit.stopping import FitState, Watch, usual_patience
from tomo_polysplat.settings import make_settings

__all__ = ["stopping"]


class _Pass:
    """Stands for the Gaussians of a pass, of which the rule keeps a copy."""

    def __init__(self, number: int) -> None:
        self.number = number

    def copy(self) -> _Pass:
        return self

    def finite(self) -> bool:
        return True


def stopping(history: Sequence[Mapping[str, Any]], settings: Mapping[str, Any]) -> dict[str, Any] | None:
    """Let the stopping rule judge a run that went on, pass by pass.

    Parameters
    ----------
    history : sequence of mappings
        ``iteration``, ``seconds``, ``loss``, ``held_out`` (or None) and ``psnr`` of every pass, from a run that
        was not ended by the rule.
    settings : mapping
        Changes of the solver's settings.

    Returns
    -------
    dict or None
        ``passes``; ``stops_after``, ``keeps`` and ``best``, numbers of passes from 1: where the rule ends the
        run, which pass it keeps, and which has the highest PSNR without metal; ``missed_db``, by how much the
        kept one is below; and ``correlation``, Spearman's, between the held-out error and the true one. None
        for a history of fewer than two passes.
    """
    if len(history) < 2:
        return None
    patience = make_settings(changes=settings).patience or usual_patience(len(history))
    watch: Watch[_Pass] = Watch(patience)
    stops = len(history)
    for number, point in enumerate(history, start=1):
        held_out = math.nan if point["held_out"] is None else point["held_out"]
        state = FitState(
            point["seconds"], point["iteration"], 0, point["loss"], held_out, 0.0, lambda: np.empty(0)
        )
        if watch.judge(state, _Pass(number)):
            stops = number
            break
    psnr = np.array([point["psnr"] for point in history])
    keeps, best = watch.best.number, int(psnr.argmax()) + 1  # type: ignore[union-attr]
    return {
        "passes": len(history),
        "stops_after": stops,
        "keeps": keeps,
        "best": best,
        "missed_db": float(psnr[best - 1] - psnr[keeps - 1]),
        "correlation": _rank_correlation(history),
    }


def _rank_correlation(history: Sequence[Mapping[str, Any]]) -> float | None:
    """Spearman's, of the passes whose held-out error is known."""
    pairs = [(p["held_out"], p["rmse"]) for p in history if p["held_out"] is not None]
    if len(pairs) < 3 or np.ptp(pairs, axis=0).min() == 0:
        return None
    from scipy.stats import spearmanr  # takes a second

    return float(spearmanr(*zip(*pairs)).statistic)

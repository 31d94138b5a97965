"""The pictures of a Data Exchange file, and what their numbers are."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from tomo_polysplat.checks import fail, require_choice
from tomo_polysplat.scan.hdf5 import find_array, find_group, text_attribute
from tomo_polysplat.scan.reading import INPUT_KINDS

if TYPE_CHECKING:
    import h5py

    from tomo_polysplat.scan.hdf5_array import StoredArray

__all__ = ["input_kind", "pictures_of", "references_of"]

logger = logging.getLogger(__name__)


def pictures_of(file: h5py.File, path: Path) -> StoredArray:
    """``/exchange/data``; refuses a file that has none of three axes."""
    exchange = find_group(file, "exchange")
    data = None if exchange is None else find_array(exchange, "data")
    if data is None or data.ndim != 3 or 0 in data.shape:
        got = "no such dataset" if data is None else f"shape {data.shape}"
        remedy = (
            "NXtomo and CIL's NeXus are read too; else copy the projections there with h5py, or into TIFFs"
        )
        expected = "a dataset /exchange/data of shape (views, rows, columns)"
        raise fail("path", expected, f"{got} in {path}", remedy)
    return data


def references_of(file: h5py.File, name: str) -> list[StoredArray]:
    """What there is of ``/exchange/data_white`` or ``data_dark``, also of before and after (``_pre``, ``_post``)."""
    found = [find_array(file, f"exchange/{name}{end}") for end in ("", "_pre", "_post")]
    return [frames for frames in found if frames is not None and frames.size]


def input_kind(data: StoredArray, has_white: bool, stated: str | None) -> str:
    """What the numbers are: as the caller or the file states it, else as they look, with a warning."""
    if stated is not None:
        return stated
    attribute = text_attribute(data, "input")
    if attribute is not None:
        return require_choice("attribute 'input' of /exchange/data", attribute, INPUT_KINDS)
    if has_white:
        return "counts"
    sample = np.asarray(data[:: max(1, data.shape[0] // 8)], np.float64)
    sample = sample[np.isfinite(sample)]
    if sample.size and np.percentile(sample, 99) > 30:
        raise fail(
            "input",
            "open-beam images (/exchange/data_white) for what looks like counts",
            "none",
            "or state input=",
        )
    # Air is the commonest value at one end: near 1 in transmission, near 0 in attenuation.
    kind = "transmission" if sample.size and 0.7 < np.percentile(sample, 95) < 1.3 else "attenuation"
    logger.warning("no open-beam images: the data look like %s; pass input= to be sure", kind)
    return kind

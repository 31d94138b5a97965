"""One self-contained page about a reconstruction: no script, no link, images inside."""

from __future__ import annotations

import base64
import html
import logging
import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from tomo_polysplat.checks import require_shape, visible
from tomo_polysplat.files import write_text
from tomo_polysplat.plan.answer import Answer
from tomo_polysplat.report import table as tables
from tomo_polysplat.report.figures import history_figure, png_bytes, slices_figure
from tomo_polysplat.report.slices import display_window, planes_through
from tomo_polysplat.report.style import ACCENT, INK, OURS, QUIET

if TYPE_CHECKING:
    from tomo_polysplat.result.result import Result

__all__ = ["image", "page", "write_report"]

logger = logging.getLogger(__name__)

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: {ink};
       max-width: 62rem; margin: 2rem auto; padding: 0 1rem; }}
h1 {{ font-size: 1.6rem; margin-bottom: 0; }}
h2 {{ font-size: 1.1rem; margin: 2.2rem 0 0.4rem; color: {accent}; }}
img {{ max-width: 100%; }}
table {{ border-collapse: collapse; }}
th, td {{ text-align: left; vertical-align: top; padding: 0.15rem 1.2rem 0.15rem 0; }}
th {{ font-weight: normal; color: {quiet}; }}
.note {{ color: {quiet}; margin-top: 0; }}
</style>
</head>
<body>
{body}
</body>
</html>
"""


def write_report(
    result: Result,
    path: str | os.PathLike,
    *,
    truth: np.ndarray | None = None,
    metal_mask: np.ndarray | None = None,
    overwrite: bool = False,
) -> None:
    """Write the page; see :meth:`tomo_polysplat.result.result.Result.report`."""
    volume = _spatial(result, result.volume)
    true = None if truth is None else _spatial(result, truth)
    metal = None if metal_mask is None else _spatial(result, metal_mask).astype(bool)
    title = f"tomo-polysplat reconstruction{_of_what(result)}"
    body = [
        f"<h1>{_text(title)}</h1>",
        f'<p class="note">{_text(repr(result))}</p>',
        *_slices(result, volume, true, metal),
        *_errors(result, volume, true, metal),
        "<h2>Speed against error</h2>",
        image(png_bytes(history_figure(result.history)), "error of the projections against seconds"),
        *_section("What was modelled and why", {name: _told(answer) for name, answer in result.plan.items()}),
        *_section("Left out or limited", result.counts),
        *_section("Settings", result.settings),
        *_section("Made from and with", result.provenance),
    ]
    write_text(path, page(title, body), overwrite=overwrite)


def page(title: str, body: Sequence[str]) -> str:
    """A whole page of these parts, which are HTML."""
    return PAGE.format(title=_text(title), body="\n".join(body), ink=INK, accent=ACCENT, quiet=QUIET)


def _text(words: Any) -> str:
    """Words as they stand in HTML."""
    return html.escape(visible(words))


def _of_what(result: Result) -> str:
    """The scan's name, where somebody has told it."""
    name = result.provenance.get("scan")
    return f" of {name}" if name else ""


def image(png: bytes, description: str) -> str:
    """A picture inside the page."""
    data = base64.b64encode(png).decode("ascii")
    return f'<img alt="{_text(description)}" src="data:image/png;base64,{data}">'


def _spatial(result: Result, volume: np.ndarray) -> np.ndarray:
    """As (z, y, x) with y ascending, whatever order the caller's geometry has."""
    volume = np.asarray(volume)
    require_shape("truth, metal_mask", volume, result.volume.shape, "of the volume")
    return volume[None, ::-1] if result.flipped_2d else volume


def _slices(
    result: Result, volume: np.ndarray, truth: np.ndarray | None, metal: np.ndarray | None
) -> list[str]:
    window = display_window(volume if truth is None else truth, metal)
    planes = planes_through(volume if metal is None else metal)
    volumes = [("reconstruction", volume), *([] if truth is None else [("truth", truth)])]
    figure = slices_figure(volumes, result.unit, result.energy_kev, window, planes)
    note = f"All slices are shown from {window[0]:.3g} to {window[1]:.3g} 1/{result.unit}; brighter is white."
    return [
        "<h2>Slices</h2>",
        f'<p class="note">{_text(note)}</p>',
        image(png_bytes(figure), "orthogonal slices"),
    ]


def _errors(
    result: Result, volume: np.ndarray, truth: np.ndarray | None, metal: np.ndarray | None
) -> list[str]:
    if truth is None:
        return []
    from tomo_polysplat.result.metrics import compare

    try:
        entry = {"name": OURS, "seconds": result.seconds, **compare(volume, truth, metal)}
    except ValueError as error:  # of a volume two voxels high, say, which the page still shows
        logger.warning("Not compared with the truth: %s", error)
        return _section("Against the truth", {"not compared": str(error)})
    rows = dict(zip(tables.headings(result.unit)[1:], tables.cells(entry)[1:]))
    return _section("Against the truth", rows)


def _section(heading: str, content: Mapping[str, Any]) -> list[str]:
    return [f"<h2>{heading}</h2>", _rows(content)] if content else []


def _told(answer: Answer) -> Any:
    """An answer in words, or what it holds by name."""
    return answer.value if isinstance(answer.value, Mapping) and not answer.why else str(answer)


def _rows(content: Mapping[str, Any]) -> str:
    lines = (f"<tr><th>{_text(key)}</th><td>{_value(item)}</td></tr>" for key, item in content.items())
    return f"<table>{''.join(lines)}</table>"


def _value(item: Any) -> str:
    if isinstance(item, Mapping):
        return _rows(item)
    if isinstance(item, (list, tuple)):
        return "<br>".join(_value(part) for part in item)
    return _text(f"{item:.6g}" if isinstance(item, (float, np.floating)) else item)

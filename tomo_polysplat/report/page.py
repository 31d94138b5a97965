"""A page that stands alone: its look, and the parts that are put together on it."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from tomo_polysplat.checks import visible
from tomo_polysplat.report.style import ACCENT, INK, QUIET

__all__ = ["data_uri", "folded", "image", "page", "rows", "section", "text"]

PAGE = """<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: {ink}; background: #fff;
       max-width: 62rem; margin: 1.2rem auto; padding: 0 1rem; }}
h1 {{ font-size: 1.6rem; line-height: 1.2; margin: 0; }}
h2 {{ font-size: 1.1rem; margin: 2.2rem 0 0.4rem; color: {accent}; }}
img {{ max-width: 100%; }}
table {{ border-collapse: collapse; }}
th, td {{ text-align: left; vertical-align: top; padding: 0.15rem 1.2rem 0.15rem 0; }}
th {{ font-weight: normal; color: {quiet}; }}
td {{ overflow-wrap: anywhere; }}
.note {{ color: {quiet}; margin-top: 0; }}
.verdict {{ border-left: 4px solid {accent}; margin: 0.9rem 0; padding: 0.1rem 0 0.1rem 0.9rem; }}
.verdict p {{ margin: 0.35rem 0; }}
.pair {{ display: flex; gap: 0.6rem; align-items: flex-start; }}
.pair figure {{ margin: 0; flex: 1 1 0; min-width: 0; }}
.pair img {{ width: 100%; display: block; image-rendering: pixelated; background: #000; }}
figcaption {{ font-weight: 600; margin-bottom: 0.2rem; }}
.browse label {{ display: flex; gap: 0.8rem; align-items: center; margin: 0.4rem 0; color: {quiet}; }}
.browse input {{ flex: 1; accent-color: {accent}; }}
.browse output {{ min-width: 9rem; text-align: right; font-variant-numeric: tabular-nums; }}
.bar {{ height: 0.6rem; background: linear-gradient(to right, #000, #fff); border: 1px solid #999; flex: 1; }}
.window {{ display: flex; gap: 0.6rem; align-items: center; color: {quiet}; font-size: 0.9rem; }}
dt {{ font-weight: 600; margin-top: 0.5rem; }}
dd {{ margin-left: 1.2rem; overflow-wrap: anywhere; }}
.status {{ font-weight: normal; font-size: 0.8rem; color: {quiet}; border: 1px solid #bbb; border-radius: 0.6rem;
          padding: 0 0.45rem; margin-left: 0.4rem; }}
details {{ margin: 0.5rem 0; }}
summary {{ cursor: pointer; color: {accent}; font-weight: 600; }}
@media print {{
  body {{ font-size: 10pt; max-width: none; margin: 0; }}
  .browse label {{ display: none; }}
  h2 {{ break-after: avoid; }}
  img, figure, .pair, tr, .verdict {{ break-inside: avoid; }}
  * {{ print-color-adjust: exact; -webkit-print-color-adjust: exact; }}
}}
</style>
</head>
<body>
{body}
</body>
</html>
"""


def page(title: str, body: Sequence[str]) -> str:
    """A whole page of these parts, which are HTML."""
    return PAGE.format(title=text(title), body="\n".join(body), ink=INK, accent=ACCENT, quiet=QUIET)


def text(words: Any) -> str:
    """Words as they stand in HTML."""
    return html.escape(visible(words))


def data_uri(picture: bytes, kind: str = "png") -> str:
    """A picture as an address that holds it."""
    return f"data:image/{kind};base64,{base64.b64encode(picture).decode('ascii')}"


def image(png: bytes, description: str) -> str:
    """A picture inside the page."""
    return f'<img alt="{text(description)}" src="{data_uri(png)}">'


def section(heading: str, content: Mapping[str, Any]) -> list[str]:
    """A heading and the rows below it; nothing where there are none."""
    return [f"<h2>{text(heading)}</h2>", rows(content)] if content else []


def folded(heading: str, content: Mapping[str, Any]) -> list[str]:
    """The same, shown when somebody asks for it."""
    if not content:
        return []
    return [f"<details><summary>{text(heading)} ({len(content)})</summary>{rows(content)}</details>"]


def rows(content: Mapping[str, Any]) -> str:
    """Names and values as a table, tables within it where a value holds names itself."""
    lines = (f"<tr><th>{text(key)}</th><td>{_value(item)}</td></tr>" for key, item in content.items())
    return f"<table>{''.join(lines)}</table>"


def _value(item: Any) -> str:
    if isinstance(item, Mapping):
        return rows(item)
    if isinstance(item, (list, tuple)):
        return "<br>".join(_value(part) for part in item)
    return text(f"{item:.6g}" if isinstance(item, (float, np.floating)) else item)

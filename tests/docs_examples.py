"""The Python blocks of a page of the docs, run as they are printed."""

import re
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[1] / "docs"


def run_page(name: str) -> tuple[list[str], dict[str, Any]]:
    """The blocks of a page, and the names that they leave."""
    text = (DOCS / name).read_text(encoding="utf-8")
    blocks, names = re.findall(r"```python\n(.*?)```", text, re.DOTALL), {}
    for block in blocks:
        exec(block, names)
    return blocks, names

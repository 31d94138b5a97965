"""Print the figures the project keeps an eye on: the suite's wall time, README's words, the longest line of docs.

python -m pytest -n 2 --dist loadfile --junitxml suite.xml
python scripts/figures.py suite.xml

The saved output of pytest, ``suite.log``, serves as well.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).resolve().parents[1]


def words_outside_code(text: str) -> int:
    """Words of Markdown text, without its fenced blocks."""
    return len(re.sub(r"^```.*?^```", "", text, flags=re.S | re.M).split())


def longest_line(folder: Path) -> tuple[int, str]:
    """Characters in the longest line of a folder's Markdown pages, and ``file:line``."""
    lines = (
        (len(line), f"{page.relative_to(folder)}:{number}")
        for page in sorted(folder.rglob("*.md"))
        if not {"_build", "gallery", "generated"} & set(page.parts)
        for number, line in enumerate(page.read_text(encoding="utf-8").splitlines(), 1)
    )
    return max(lines)


def suite_seconds(report: Path) -> float:
    """Wall time of a test run, in seconds, from pytest's ``--junitxml`` or from its saved output (``in 271.3s``)."""
    if report.suffix == ".xml":
        return sum(float(suite.get("time", 0)) for suite in ElementTree.parse(report).iter("testsuite"))
    ends = re.findall(
        r"\d (?:passed|failed|error|skipped)\w*.* in ([\d.]+)s", report.read_text(encoding="utf-8")
    )
    if not ends:
        raise SystemExit(
            f"{report}: neither pytest's --junitxml (.xml) nor an output of pytest that ends with its seconds"
        )
    return float(ends[-1])


def main() -> None:
    """Print each figure on a line."""
    if len(sys.argv) > 1:
        print(f"suite: {suite_seconds(Path(sys.argv[1])):.0f} s")
    print(
        f"README: {words_outside_code((ROOT / 'README.md').read_text(encoding='utf-8'))} words outside code"
    )
    length, place = longest_line(ROOT / "docs")
    print(f"docs: longest line {length} characters, {place}")


if __name__ == "__main__":
    main()

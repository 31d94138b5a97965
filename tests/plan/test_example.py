"""The example of a new decision in the docs works as printed."""

import re
from pathlib import Path

PAGE = Path(__file__).parents[2] / "docs" / "new_decision.md"


def test_the_example_of_the_docs_runs():
    names = {}
    blocks = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert len(blocks) == 2
    for block in blocks:
        exec(block, names)
    tests = [name for name in names if name.startswith("test_")]
    assert len(tests) == 1 and len(blocks[1].split("def ")[1].splitlines()) < 15
    names[tests[0]]()

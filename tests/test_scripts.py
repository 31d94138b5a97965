"""Scripts that keep an eye on the code."""

import runpy
from pathlib import Path

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


def test_numbers_at_the_head_of_a_module_are_counted():
    count = runpy.run_path(str(SCRIPTS / "constants.py"))["constants"]
    source = """
# Chosen on two scans.
_SHARE, _MANY = 0.3, (1, 2.5)
_NEXT = 1 << 20

_BARE: float = -3.0
__all__ = ["a"]
NAMES = {"a": "b"}
TABLE = {"x": 1.0, "y": (2, True)}
lower = 4

def f():
    INSIDE = 5
"""
    assert list(count(source)) == [
        ("_SHARE, _MANY", 3, 3, True),
        ("_NEXT", 4, 1, True),
        ("_BARE", 6, 1, False),
        ("TABLE", 9, 2, False),
    ]

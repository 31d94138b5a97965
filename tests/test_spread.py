"""The lists by which tests are spread over workers name files that exist."""

from pathlib import Path
from types import SimpleNamespace

import pytest

spread = pytest.importorskip("spread", reason="needs pytest-xdist", exc_type=ImportError)


@pytest.mark.parametrize("name", sorted({*spread.LONGEST, *spread.SPLIT, *spread.AFTER}))
def test_the_named_files_exist(name):
    assert (Path(__file__).resolve().parents[1] / name).is_file()


def test_the_longest_begin_and_the_others_keep_their_order():
    (behind, before), *_ = spread.AFTER.items()
    names = [
        "tests/b.py::one",
        "tests/a.py::two",
        f"{behind}::three",
        f"{spread.LONGEST[-1]}::four",
        f"{before}::five",
        f"{spread.LONGEST[0]}::six",
    ]
    items = [SimpleNamespace(nodeid=name) for name in names]
    spread.begin_with_the_longest(items)
    assert [item.nodeid.split("::")[1] for item in items] == ["six", "five", "three", "four", "one", "two"]

"""What the tests of benchmarks share."""

from types import SimpleNamespace

import pytest

from tomo_polysplat.bench import measure


@pytest.fixture(autouse=True)
def no_search_before_a_run(monkeypatch):
    """Memory is not compared here: to look through all that the tests have loaded takes longer than most runs."""
    monkeypatch.setattr(measure, "gc", SimpleNamespace(collect=lambda: 0))

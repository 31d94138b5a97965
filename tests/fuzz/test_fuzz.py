"""A short run of what `python -m tests.campaign` does at length."""

import pytest
from hypothesis import HealthCheck, given, settings
from targets import TARGETS

QUIET = [HealthCheck.too_slow, HealthCheck.function_scoped_fixture, HealthCheck.data_too_large]


@pytest.mark.parametrize("name", TARGETS)
def test_hostile_input_is_refused_in_words(name, tmp_path):
    target, inputs = TARGETS[name]
    accepted = []

    @settings(max_examples=30, deadline=None, derandomize=True, database=None, suppress_health_check=QUIET)
    @given(inputs)
    def run(case):
        accepted.append(target(case, tmp_path))

    run()
    assert True in accepted and False in accepted, "all alike: nothing was tried"

"""Fuzzing of the readers led by their own branches: ``python tests/fuzz/guided.py "npz scans" -max_total_time=60``.

Needs atheris (python -m pip install atheris), whose options follow the target. It sees the branches of this package
only; what NumPy and HDF5 do with a file is looked at by `python -m tests.campaign`.
"""

import sys
import tempfile
from pathlib import Path

import atheris
from hypothesis import HealthCheck, given, settings

with atheris.instrument_imports(include=["tomo_polysplat"]):
    from targets import TARGETS


def main() -> None:
    target, inputs = TARGETS[sys.argv.pop(1)]
    folder = Path(tempfile.mkdtemp())

    @settings(deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(inputs)
    def run(case):
        target(case, folder)

    atheris.Setup(sys.argv, run.hypothesis.fuzz_one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()

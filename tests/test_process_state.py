"""Public calls leave environment variables, warning filters and torch's threads as they were, the first ones too."""

import gc
import os
import subprocess
import sys

import pytest

from tomo_polysplat.quiet_imports import leaving_no_trace

# In a fresh process, where everything is still to be loaded.
CALLS = """
import os, sys, warnings

def state():
    threads = sys.modules["torch"].get_num_threads() if "torch" in sys.modules else None
    return dict(os.environ), [str(each) for each in warnings.filters], threads

def same(name, before):
    for what, was, now in zip(("environment", "warnings", "threads"), before, state()):
        if was is not None and was != now:
            print(name, what, [each for each in now if each not in was])

class Watched:
    def __getattr__(self, name):
        before = state()
        function = getattr(tps, name)
        same(f"import of {name}", before)
        def call(*arguments, **options):
            before = state()
            result = function(*arguments, **options)
            same(name, before)
            return result
        return call

before = state()
import tomo_polysplat as tps
same("import", before)
watched = Watched()
scan = watched.simulate_scan("pins", size=12, views=20)
for ending in ("npz", "h5"):
    watched.save_scan(scan, f"scan.{ending}")
    watched.load_scan(f"scan.{ending}")
# It takes two seconds, and nothing so far has need of it.
print(*{"torch"} & {*sys.modules})
watched.register()
import torch
torch.set_num_threads(2)
result = watched.reconstruct(
    scan.projections, scan.proj_geom, scan.vol_geom, spectrum=scan.spectrum, unit=scan.unit,
    settings={"passes": 0.5}, device="auto",
)
from tomo_polysplat.scan.slopes import slope_at_zero
assert float(slope_at_zero(lambda x: 3 * x)) == 3.0
# They take more than a second each, in every process that fits; nor do slopes of moves need them. Triton is for GPUs.
# What is drawn in notebooks is for them.
unused = {"torch._dynamo", "sympy", "ipywidgets"} | ({"triton"} if not torch.cuda.is_available() else set())
print(*unused & {*sys.modules})
for name, path in (("save", "volume.h5"), ("save_tiff", "slices.tif"), ("report", "report.html")):
    before = state()
    getattr(result, name)(path)
    same(name, before)
"""


def test_the_first_call_of_each_function_changes_nothing_and_loads_nothing_in_vain(tmp_path):
    child = subprocess.run(
        [sys.executable, "-c", CALLS], capture_output=True, text=True, timeout=120, cwd=tmp_path
    )
    assert child.returncode == 0, child.stderr
    assert child.stdout.strip() == ""


def test_the_garbage_collector_rests_meanwhile_and_is_then_as_it_was():
    for before in (True, False):
        try:
            (gc.enable if before else gc.disable)()
            with leaving_no_trace(), leaving_no_trace():
                assert not gc.isenabled()
            assert gc.isenabled() == before
        finally:
            gc.enable()


ENDING = """
import gc
from tomo_polysplat.quiet_imports import ending_quickly

class Circle:
    def __init__(self):
        self.itself = self
    def __del__(self):
        print("looked for")

{}
circle = Circle()
del circle
"""


def test_a_process_of_ours_ends_without_looking_for_circles():
    for call, told in (("", "looked for"), ("ending_quickly()", "")):
        child = subprocess.run([sys.executable, "-c", ENDING.format(call)], capture_output=True, text=True)
        assert child.stdout.strip() == told


def test_variables_that_are_set_deleted_or_changed_come_back(monkeypatch):
    monkeypatch.setenv("TPS_CHANGED", "before")
    monkeypatch.setenv("TPS_DELETED", "before")
    with pytest.raises(KeyError), leaving_no_trace():
        os.environ["TPS_NEW"] = "within"
        os.environ["TPS_CHANGED"] = "within"
        del os.environ["TPS_DELETED"]
        raise KeyError
    assert "TPS_NEW" not in os.environ
    assert os.environ["TPS_CHANGED"] == os.environ["TPS_DELETED"] == "before"

"""What memory does not hold is refused before any of it is taken, with bytes needed, bytes free and a remedy."""

import time
import tracemalloc

import astra
import numpy as np
import pytest
import torch
from small_scans import cone

import tomo_polysplat as tps
from tomo_polysplat import free_memory
from tomo_polysplat.fit import memory
from tomo_polysplat.free_memory import available_memory, bytes_of, limit_memory, require_memory
from tomo_polysplat.scan.usable import usable_rays

REMEDIES = {
    "vol_geom": "fewer or larger voxels",
    "projections": "fewer views",
    "spectrum": "rebin the spectrum",
}


@pytest.fixture
def grouped(tmp_path, monkeypatch):
    """A function that puts the process into control groups of some limits, use and files, by path."""

    def put(own, groups, version=""):
        names = (
            ("memory.max", "memory.current")
            if not version
            else ("memory.limit_in_bytes", "memory.usage_in_bytes")
        )
        for path, (limit, used, files) in groups.items():
            folder = tmp_path / version / path
            folder.mkdir(parents=True, exist_ok=True)
            stat = f"anon 5\n{'total_' if version else ''}inactive_file {files}\nother 7\n"
            for name, text in zip((*names, "memory.stat"), (limit, used, stat)):
                (folder / name).write_text(f"{text}\n")
        (tmp_path / "cgroup").write_text(f"7:cpu:/x\n{'4' if version else '0'}:{version}:/{own}\n")
        (tmp_path / "meminfo").write_text("MemTotal: 9000 kB\nMemAvailable:   8000 kB\n")

    for name, file in (("_MEMINFO", "meminfo"), ("_OWN_GROUPS", "cgroup"), ("_GROUPS", ".")):
        monkeypatch.setattr(free_memory, name, tmp_path / file)
    return put


@pytest.mark.parametrize("version", ["", "memory"])
def test_the_tightest_limit_around_a_process_counts(grouped, version):
    machine = 8000 * 1024
    grouped("job/step", {"job/step": (3_000_000, 1_000_000, 300_000)}, version)
    assert available_memory() == 2_300_000
    grouped("job/step", {"job": (2_000_000, 1_500_000, 0)}, version)
    assert available_memory() == 500_000
    grouped("job/step", {"job": (1_000_000, 1_500_000, 0)}, version)
    assert available_memory() == 0
    grouped("elsewhere", {".": (700_000, 0, 0)}, version)
    assert available_memory() == 700_000
    grouped("elsewhere", {".": ("max", 0, 0)}, version)
    assert available_memory() == machine


def test_a_limit_is_what_a_process_may_hold_in_all(monkeypatch):
    held = free_memory._held()
    with free_memory.memory_limits():
        limit_memory("2 GB", "cuda")
        assert available_memory() > held // 10, "the host is not the GPU"
        monkeypatch.setattr(free_memory, "_held", lambda: 10**6)
        limit_memory("3MB", "cpu")
        assert available_memory() == 2_000_000
        limit_memory(1000.0, "cpu")
        assert available_memory() == 0
        monkeypatch.setattr(torch.cuda, "memory_allocated", lambda device: 5 * 10**8)
        monkeypatch.setattr(torch.cuda, "memory_reserved", lambda device: 6 * 10**8)
        monkeypatch.setattr(torch.cuda, "mem_get_info", lambda device: (10**10, 10**11))
        assert free_memory.free_bytes(torch.device("cuda", 0)) == 15 * 10**8
    assert available_memory() > 2_000_000
    assert free_memory.free_bytes(torch.device("cuda", 0)) == 101 * 10**8


@pytest.mark.parametrize(
    ("text", "size"),
    [("12 GB", 12e9), ("500mb", 5e8), ("1.5 GiB", 1.5 * 2**30), ("7", 7.0), (8e9, 8e9), (".5 TB", 5e11)],
)
def test_bytes_are_read_as_people_write_them(text, size):
    assert bytes_of(text, "memory") == size


@pytest.mark.parametrize("text", ["", "GB", "12 XB", "0 GB", "-1 GB", "nan", 0, -1.0, float("nan"), [1]])
def test_what_is_no_size_is_refused(text):
    with pytest.raises((ValueError, TypeError), match="memory"):
        tps.reconstruct(None, settings={"memory": text})


def test_too_small_a_limit_is_told_before_the_work():
    scan = cone(12, 20)
    with pytest.raises(MemoryError, match=r"0 MB that settings.* leaves .*raise settings\['memory'\]"):
        tps.reconstruct(scan, settings={"memory": "1 MB"}, device="cpu")


def test_a_machine_that_does_not_say_refuses_nothing(tmp_path, monkeypatch):
    for name in ("_MEMINFO", "_OWN_GROUPS"):
        monkeypatch.setattr(free_memory, name, tmp_path / "none")
    assert available_memory() is None
    require_memory({"volume": ("voxels", 1e30)}, {})


def test_this_machine_says_what_an_array_takes():
    free = available_memory()
    assert free is None or 2**20 < free < 2**50


def too_large(what):
    """Arguments of a scan of which one thing is too large, without taking the memory."""
    scan = cone(12, 20)
    arguments = {"projections": scan.projections, "proj_geom": scan.proj_geom, "vol_geom": scan.vol_geom}
    options = {"spectrum": scan.spectrum, "unit": scan.unit}
    if what == "vol_geom":
        arguments["vol_geom"] = astra.create_vol_geom(30_000, 30_001, 30_002, -1, 1, -1, 1, -1, 1)
    elif what == "projections":
        turn = np.linspace(0, 6, 2000)
        arguments["proj_geom"] = astra.create_proj_geom("cone", 0.01, 0.01, 70_000, 70_001, turn, 9.0, 9.0)
        arguments["projections"] = np.broadcast_to(np.float32(0.5), (70_000, 2000, 70_001))
    else:
        options["spectrum"] = tps.Spectrum(np.linspace(20, 90, 100_000), np.ones(100_000))
    return arguments, options


@pytest.mark.parametrize("what", REMEDIES)
def test_what_a_machine_cannot_hold_is_refused_at_once(what, monkeypatch):
    arguments, options = too_large(what)
    if what == "spectrum":  # a large machine holds it
        monkeypatch.setattr(free_memory, "available_memory", lambda: 2 * 10**9)
    started = time.perf_counter()
    with pytest.raises(MemoryError, match=rf"^{what}: .* GB of memory .*about .* GB .*{REMEDIES[what]}"):
        tps.reconstruct(*arguments.values(), **options)
    assert time.perf_counter() - started < 1


def test_a_volume_that_a_gpu_cannot_hold_is_refused_at_once(monkeypatch):
    device = torch.device("cuda", 0)
    monkeypatch.setattr(memory, "free_bytes", lambda device: int(5e9))
    monkeypatch.setattr(free_memory, "available_memory", lambda: int(1e11))
    memory.require_machine(10**6, 512**3, 100, device)
    with pytest.raises(MemoryError, match=r"vol_geom: .*5\.00 GB free on cuda:0.*13\.96 GB.*device='cpu'"):
        memory.require_machine(10**6, 1024**3, 100, device)
    monkeypatch.setattr(memory, "free_bytes", lambda device: int(80e9))
    memory.require_machine(10**6, 1024**3, 100, device)
    with pytest.raises(MemoryError, match="projections"):
        memory.require_machine(10**10, 256**3, 100, device)


def test_rays_and_volume_are_not_on_the_host_together_where_a_gpu_takes_the_rays(monkeypatch):
    device = torch.device("cuda", 0)
    monkeypatch.setattr(free_memory, "available_memory", lambda: int(30e9))
    monkeypatch.setattr(memory, "free_bytes", lambda device: int(80e9))
    memory.require_machine(3 * 10**9, 10**9, 100, device)
    with pytest.raises(MemoryError, match="projections"):
        memory.require_machine(4 * 10**9, 10**6, 100, device)
    monkeypatch.setattr(memory, "free_bytes", lambda device: int(20e9))
    with pytest.raises(MemoryError, match="projections"):
        memory.require_machine(3 * 10**9, 10**9, 100, device)


def test_a_mask_takes_no_copies_of_the_size_of_the_projections():
    scan = cone(24, 40)
    mask = np.ones(scan.projections.shape, bool)
    mask[3, 4, 5] = False
    usable_rays(scan.projections, scan.proj_geom, mask)
    tracemalloc.start()
    try:
        values, counts, _ = usable_rays(scan.projections, scan.proj_geom, mask)
        most = tracemalloc.get_traced_memory()[1] / mask.size
    finally:
        tracemalloc.stop()
    assert np.isnan(values[4, 3, 5]) and counts["rays_marked_invalid"] == 1 == np.isnan(values).sum()
    # The values, what is marked, and another byte while that is made; for so small a scan some 5 of what is looked at.
    assert 5 <= most < 13


def test_a_cloud_that_a_cpu_cannot_hold_is_refused(monkeypatch):
    monkeypatch.setattr(free_memory, "available_memory", lambda: int(1e9))
    small, large = (
        memory.StepSize(count, views=4, pixels=100, voxels=1000) for count in (100_000, 1_000_000)
    )
    assert "GB" in memory.require_room(torch.device("cpu"), small, 0)
    with pytest.raises(MemoryError, match=r"settings: .*1\.00 GB.*1\.2. GB.*max_gaussians"):
        memory.require_room(torch.device("cpu"), large, 0)


def test_a_simulation_that_memory_cannot_hold_is_refused_at_once():
    started = time.perf_counter()
    with pytest.raises(MemoryError, match="size: .*fewer voxels"):
        tps.simulate_scan("pins", size=20_000, views=3, rows=5, columns=5)
    with pytest.raises(MemoryError, match="views: .*fewer views"):
        tps.simulate_scan("pins", size=20, views=10**6, rows=10**4, columns=10**4)
    assert time.perf_counter() - started < 1

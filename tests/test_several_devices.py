"""Fits shared out over processes: the same volume, also after one of them has died."""

import os
import signal
import sys
import time
from dataclasses import replace
from pathlib import Path

import astra
import numpy as np
import pytest
import torch
from shared_out import (
    ROUGH,
    SMOOTHED,
    SUMS,
    assert_sums_are_those_of_one,
    reconstruct,
    relative,
    same,
    told_to,
)
from small_scans import cone, fan
from torch.distributed import run

import tomo_polysplat as tps
from tomo_polysplat.fit import volume_by_ranks
from tomo_polysplat.fit.fitter import Fitter
from tomo_polysplat.fit.led_step import LedStep
from tomo_polysplat.fit.step import EagerStep
from tomo_polysplat.rank_processes import devices_of, sharing
from tomo_polysplat.rank_work import helpers
from tomo_polysplat.ranks import ALONE, RankFailed, Ranks, current_ranks, led_by, part_of
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.scan.io import save_scan
from tomo_polysplat.scan.moves import Scanner, moved_geometry
from tomo_polysplat.start import bridged, fdk_by_ranks, projected
from tomo_polysplat.start.initial import initial_volume_on
from tomo_polysplat.start.orbit import find_orbit

sys.path.append(str(Path(__file__).parent / "kernels"))
from step_scenes import fit_problem

SPECTRA_ARE_DOUBTED = True  # see tests/conftest.py

CPU = torch.device("cpu")
TWO = ["cpu", "cpu"]
# Signals that torchrun hands on to its processes.
ENDING = (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGQUIT)


def children():
    """Processes that follow this one and still run; other tests of this process may have left others."""
    named = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children")
    commands = {int(pid): Path(f"/proc/{pid}/cmdline") for pid in named.read_text().split()}
    return [
        pid for pid, command in commands.items() if command.exists() and b"fit.follow" in command.read_bytes()
    ]


def alone(*args, **options):
    """A fit without the other processes, while they live."""
    with led_by(ALONE):
        return reconstruct(*args, **options)


def parallel():
    return tps.simulate_scan("pins", size=17, views=30, geometry="parallel", metal=False)


def tilted():
    """A cone whose detector is turned in its plane and leans out of it."""
    scan = cone()
    proj_geom = astra.geom_2vec(scan.proj_geom)
    source, _, u, v = np.split(proj_geom["Vectors"].copy(), 4, axis=1)
    lean = 0.1 * np.linalg.norm(v) / np.linalg.norm(source) * source
    proj_geom["Vectors"][:, 6:] = np.concatenate([u + 0.05 * v, v - 0.05 * u + lean], axis=1)
    return replace(scan, proj_geom=proj_geom)


@pytest.fixture(scope="class")
def three():
    """Three processes that share out what is fitted while they live; they are started once."""
    with sharing([CPU] * 3):
        yield current_ranks()


@pytest.fixture
def connected(three):
    """The same, after they have begun to make something together."""
    if three.connect is not None:
        with three.together():
            pass
    return three


class TestThreeProcesses:
    """What they make is what one makes. About scatter, by short fits, only whole runs are asked."""

    @pytest.mark.parametrize("scan", [cone, tilted, parallel, fan])
    def test_make_the_volume_of_one(self, scan, three):
        shared, one = (made(scan(), settings=ROUGH) for made in (reconstruct, alone))
        assert three.count == 3 and shared.plan["ranks"].value == 3 and "ranks" not in one.plan
        assert "returned" not in one.plan, "the start was better, so that nothing is compared"
        assert same(shared.volume, one.volume)
        for entry, other in zip(shared.history, one.history, strict=True):
            assert entry["loss"] == pytest.approx(other["loss"], rel=1e-4)
            assert entry["held_out"] == pytest.approx(other["held_out"], rel=1e-4)

    @pytest.mark.parametrize("scan", [cone, parallel])
    def test_smooth_as_one(self, scan, three):
        shared, one = reconstruct(scan(), calibrate=False), alone(scan(), calibrate=False)
        assert "returned" not in one.plan and relative(shared.volume, one.volume) < SMOOTHED

    def test_may_be_more_than_the_views_of_a_step(self, three):
        settings = ROUGH | {"views_per_step": 2, "passes": 0.5}
        shared, one = (made(cone(), settings=settings, calibrate=False) for made in (reconstruct, alone))
        assert "returned" not in one.plan and same(shared.volume, one.volume)

    def test_compare_whole_images_where_similarity_is_asked_for(self, three):
        """Which are those of all Gaussians on each."""
        settings = ROUGH | {"ssim_weight": 0.3, "passes": 1.0}
        shared, one = (made(cone(), settings=settings, calibrate=False) for made in (reconstruct, alone))
        plain = alone(cone(), settings=settings | {"ssim_weight": 0.0}, calibrate=False)
        assert same(shared.volume, one.volume) and not same(plain.volume, one.volume)

    def test_all_see_rays_that_change_during_a_run(self, three, monkeypatch):
        """As those of which gains or drift are taken out between two passes."""
        end = Fitter._end_pass

        def less(self, share):
            told = end(self, share)
            self.rays.projections.sub_(0.02)
            self.rays.weigh_anew()
            return told

        settings = ROUGH | {"passes": 1.4}
        before = alone(cone(), settings=settings, calibrate=False)
        monkeypatch.setattr(Fitter, "_end_pass", less)
        shared, one = (made(cone(), settings=settings, calibrate=False) for made in (reconstruct, alone))
        assert same(shared.volume, one.volume) and not same(shared.volume, before.volume)

    def test_hold_others_when_gaussians_have_changed_places(self, three, monkeypatch):
        """With the optimiser's memory of them: from then on each rank's are those of another one."""
        end = Fitter._end_pass

        def turned_over(self, share):
            told = end(self, share)
            self.gaussians.position[:, 2] *= -1
            return told

        scan, settings = cone(24), ROUGH | {"passes": 1.4, "relocated": 0.0}
        anew, made = LedStep._anew, []
        monkeypatch.setattr(LedStep, "_anew", lambda step: (made.append(1), anew(step)))
        monkeypatch.setattr(Fitter, "_end_pass", torch.no_grad()(turned_over))
        shared, one = (run(scan, settings=settings, calibrate=False) for run in (reconstruct, alone))
        assert same(shared.volume, one.volume) and made

    @pytest.mark.parametrize("sums", SUMS)
    def test_take_a_part_of_the_views_each_for_sums(self, connected, monkeypatch, sums):
        """Views that go together are the same for any number of processes, so that each view's sums are, too."""
        fit = fit_problem("cone", True, "cpu", "numba", filtered=True)
        # Threads of torch cut arrays up otherwise than one does, which rounds some values otherwise.
        assert_sums_are_those_of_one(sums, fit, connected, monkeypatch, within=1e-6)

    @pytest.mark.parametrize("degrees", [0.0, 3.0])
    def test_make_slabs_of_the_first_volume(self, connected, monkeypatch, degrees):
        """Also of a rolled detector, whose rows are levelled before they are handed out."""
        monkeypatch.setattr(fdk_by_ranks, "_WORTH", 0)
        geometry, grid = from_astra(cone().proj_geom, cone().vol_geom)
        geometry = moved_geometry(Scanner(geometry), {"roll": torch.tensor(degrees, dtype=torch.float64)})
        values = torch.from_numpy(projections_from_astra(cone().projections, cone().proj_geom))
        told = told_to(connected, monkeypatch)
        shared, how = initial_volume_on(values, geometry, grid)
        assert told == ["work"] and how["method"] == "fdk"
        with led_by(ALONE):
            one, _ = initial_volume_on(values, geometry, grid)
        assert float((shared - one).abs().max()) < 1e-5 * float(one.max())
        assert float(one.max()) > 0

    def test_project_a_part_of_the_views_each_to_bridge_metal(self, connected, monkeypatch):
        monkeypatch.setattr(fdk_by_ranks, "_WORTH", 0)
        monkeypatch.setattr(projected, "_WORTH", 0)
        # Portions of 16 views, and one of 8.
        geometry, grid = from_astra(cone(metal=True).proj_geom, cone(metal=True).vol_geom)
        monkeypatch.setitem(bridged._AT_ONCE, "cpu", 16 * geometry.rows * geometry.columns)
        values = torch.from_numpy(projections_from_astra(cone(metal=True).projections, cone().proj_geom))
        volume, _ = initial_volume_on(values, geometry, grid)
        told, metal = told_to(connected, monkeypatch), 0.5 * float(volume.max())
        shared, how = bridged.bridged_start(values, volume, "fdk", geometry, grid, metal=metal)
        # Twice a volume and three portions; two volumes by filtered backprojection.
        assert told == ["work"] * 10 and "through metal bridged" in how
        with led_by(ALONE):
            one, _ = bridged.bridged_start(values, volume, "fdk", geometry, grid, metal=metal)
        assert not torch.equal(one, volume)
        assert float((shared - one).abs().max()) < 1e-5 * float(one.max())

    def test_make_the_first_volume_alone_where_one_has_no_room(self, connected, monkeypatch):
        monkeypatch.setattr(fdk_by_ranks, "_WORTH", 0)
        geometry, grid = from_astra(cone().proj_geom, cone().vol_geom)
        values = torch.from_numpy(projections_from_astra(cone().projections, cone().proj_geom))
        with monkeypatch.context() as lacking:
            lacking.setattr(fdk_by_ranks, "_made", lambda *parts: None)
            one, _ = initial_volume_on(values, geometry, grid)
        shared, _ = initial_volume_on(values, geometry, grid)
        assert connected.usable
        assert float((shared - one).abs().max()) < 1e-5 * float(one.max())

    @pytest.mark.parametrize("slices", [1, 9])
    def test_make_slices_of_the_volume(self, connected, monkeypatch, slices):
        """Of four slices one process makes two, one after the other if need be."""
        monkeypatch.setattr(volume_by_ranks, "_WORTH", 0)
        fit, told = fit_problem("cone", True, "cpu", "numba"), told_to(connected, monkeypatch)
        nz, ny, nx = fit.scene.box.shape
        parts = fit.gaussians.copy(), 0.3, slices * ny * nx
        shared = [made(*parts) for made in (fit.scene.basis_on_host, fit.scene.volume_on_host)]
        assert told == ["work"] * 2 and nz % 3
        with led_by(ALONE):
            one = [made(*parts) for made in (fit.scene.basis_on_host, fit.scene.volume_on_host)]
        for together, expected in zip(shared, one):
            np.testing.assert_allclose(together, expected, rtol=1e-4, atol=1e-5 * expected.max())

    def test_stand_still_after_ctrl_c_within_a_step(self, three, monkeypatch):
        """The last thing that they do: the best state is returned, and nothing more is asked of them."""
        step, made = EagerStep.__call__, []

        def interrupted(self, *parts):
            made.append(1)
            if len(made) == 7:
                raise KeyboardInterrupt
            step(self, *parts)

        monkeypatch.setattr(EagerStep, "__call__", interrupted)
        result = reconstruct(cone())
        assert result.plan["stop"].value == "interrupted" and len(result.history) == 1
        assert np.isfinite(result.volume).all() and result.volume.any()
        assert not three.usable
        with pytest.raises(RankFailed, match="left in the middle of a step"):
            reconstruct(cone())


def test_a_process_that_dies_ends_the_run_and_its_checkpoint_goes_on_in_one(tmp_path):
    path, killed = tmp_path / "fit.npz", []
    options = {"settings": ROUGH, "calibrate": False}

    def kill(state):
        killed.append(time.monotonic())
        os.kill(children()[0], signal.SIGKILL)

    with pytest.raises(RankFailed, match=r"rank 1 of 2 \(cpu\) was ended by signal 9"):
        reconstruct(cone(), devices=TWO, callbacks=[kill], checkpoint=path, **options)
    assert len(killed) == 1 and time.monotonic() - killed[0] < 30 and not children()
    resumed = reconstruct(cone(), resume=True, checkpoint=path, **options)
    whole = reconstruct(cone(), **options)
    assert len(resumed.history) == len(whole.history) == 2
    assert same(resumed.volume, whole.volume)


def test_what_a_process_fails_of_is_told(monkeypatch):
    """Here amid the first volume, while this one waits for its part."""
    monkeypatch.setattr(fdk_by_ranks, "_WORTH", 0)
    monkeypatch.setattr(fdk_by_ranks, "_made", lambda make, piece, slab, *how: torch.zeros(slab.grid.shape))
    geometry, grid = from_astra(cone().proj_geom, cone().vol_geom)
    orbit, _ = find_orbit(geometry)
    with sharing([CPU] * 2):
        ranks = current_ranks()
        assert helpers().count == 1
        with ranks.together():
            pass
        assert helpers().count == 2
        begun = time.monotonic()
        # What the other one cannot call.
        with pytest.raises(RankFailed, match=r"rank 1 of 2 \(cpu\) failed: TypeError: .*abort"):
            fdk_by_ranks.fdk_by_ranks(os.abort, np.zeros(geometry.shape), geometry, grid, orbit, "hann")
        assert time.monotonic() - begun < 30
        with pytest.raises(RankFailed, match="abort"), ranks.together():
            pass
    assert not children()


def test_torchrun_reconstructs_by_the_command_line(tmp_path, monkeypatch, capfd):
    """By what the command `torchrun` calls, in this process, which has torch already."""
    save_scan(fan(metal=False), tmp_path / "scan.npz")
    about = [
        arg for name, value in ROUGH.items() if value is not None for arg in ("--set", f"{name}={value}")
    ]
    command = ["--nproc-per-node=2", "-m", "tomo_polysplat", "recon", "scan.npz", "-o", "volume.npy"]
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("OMP_NUM_THREADS", "1")
    kept = {number: signal.getsignal(number) for number in ENDING}
    try:
        run.main(
            [*command, "--json", "about.json", *about, "--device", "cpu", "--no-calibrate", "--no-align"]
        )
    finally:
        for number, handler in kept.items():
            signal.signal(number, handler)
    told = capfd.readouterr().out
    assert told.count("wrote volume.npy") == 1 and '"ranks"' in (tmp_path / "about.json").read_text()
    alike = reconstruct(fan(metal=False), settings=ROUGH, calibrate=False)
    assert same(np.load(tmp_path / "volume.npy"), alike.volume)


@pytest.mark.parametrize("device", ["cpu", "cuda"])
@pytest.mark.parametrize("here", [False, True])
def test_nobody_waits_for_processes_that_have_still_to_start(device, here):
    """And on CPUs what is made, to the bit, does not depend on how soon they do."""
    with led_by(Ranks(0, 2, torch.device(device), connect=print, all_here=lambda: here)):
        assert helpers().count == (2 if here and device == "cuda" else 1)


@pytest.mark.parametrize("length", [0, 1, 2, 7, 12])
def test_parts_of_ranks_are_all_and_differ_by_one_at_most(length):
    for count in (1, 2, 3, 5):
        parts = [list(range(length))[part_of(length, rank, count)] for rank in range(count)]
        assert sum(parts, []) == list(range(length))
        assert max(map(len, parts)) - min(map(len, parts)) <= 1


def test_devices_by_name(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 3)
    assert devices_of(None, "cpu") is None
    assert devices_of("all", "auto") == ["cuda:0", "cuda:1", "cuda:2"]
    assert devices_of("0,2", "auto") == devices_of([0, 2], "auto") == devices_of(["cuda:0", "cuda:2"], "auto")
    assert devices_of(TWO, "auto") == TWO
    for wrong, device in (
        ([0, 0], "auto"),
        (["cpu", 0], "auto"),
        ([], "auto"),
        (2, "auto"),
        ([0, 1], "cuda:0"),
    ):
        with pytest.raises(ValueError, match="device"):
            devices_of(wrong, device)

"""A run that was interrupted and resumed is the run that was not; a checkpoint of anything else is refused."""

import json
import math
import os
import zipfile
from functools import cache

import numpy as np
import pytest
from killed_runs import Killed
from small_scans import ASKED, QUICK, cone, fan, reconstruct

from tomo_polysplat.plan.checkpoint import Checkpoint

# Relocation falls between the passes, metals are freed after two of five, and the state changes in all its parts.
LONG = QUICK | ASKED | {"passes": 5.0, "relocate_until": 1.0}


def killed_after(passes, scan, path, **options):
    """Run up to a pass, and die there."""

    def die(state):
        if state.iteration >= passes * 5:
            raise Killed

    with pytest.raises(Killed):
        reconstruct(scan, checkpoint=path, callbacks=[die], **options)


@pytest.fixture(autouse=True)
def every_pass(monkeypatch):
    """Small scans take less time than a file: write nevertheless."""
    monkeypatch.setattr("tomo_polysplat.plan.checkpoint._LARGEST_SHARE", 1e9)


@pytest.fixture(scope="module")
def after_a_pass(tmp_path_factory):
    """The bytes of the checkpoint of a run that died after its first pass."""
    path = tmp_path_factory.mktemp("killed") / "fit.npz"
    killed_after(1, fan(), path, settings=LONG)
    return path.read_bytes()


@pytest.fixture
def killed(tmp_path, after_a_pass):
    """The path of that checkpoint, for a test to do with as it likes."""
    path = tmp_path / "fit.npz"
    path.write_bytes(after_a_pass)
    return path


@cache
def uninterrupted():
    """The whole run, which several tests compare with."""
    return reconstruct(fan(), settings=LONG)


def without_seconds(history):
    return [{name: value for name, value in record.items() if name != "seconds"} for record in history]


@pytest.mark.parametrize("spectrum", [True, False])
def test_a_resumed_run_is_the_uninterrupted_one(tmp_path, spectrum):
    scan, path = fan(), tmp_path / "fit.npz"
    options = {"settings": LONG} | ({} if spectrum else {"spectrum": None})
    whole = uninterrupted() if spectrum else reconstruct(scan, **options)
    killed_after(3, scan, path, **options)
    resumed = reconstruct(scan, checkpoint=path, resume=True, **options)
    assert np.array_equal(resumed.volume, whole.volume)
    assert all(np.array_equal(resumed.gaussians[name], whole.gaussians[name]) for name in whole.gaussians)
    assert without_seconds(resumed.history) == without_seconds(whole.history)
    assert resumed.counts == whole.counts and resumed.plan == whole.plan
    assert whole.counts["gaussians_relocated"] > 0 or not spectrum


def test_a_run_resumed_at_every_pass_is_the_uninterrupted_one(tmp_path):
    scan, path = cone(17, 40), tmp_path / "fit.npz"
    whole = reconstruct(scan, settings=LONG)
    for passes in range(1, 5):
        killed_after(passes, scan, path, settings=LONG, resume=passes > 1)
    resumed = reconstruct(scan, settings=LONG, checkpoint=path, resume=True)
    assert np.array_equal(resumed.volume, whole.volume) and len(resumed.history) == 5
    seconds = [record["seconds"] for record in resumed.history]
    assert seconds == sorted(seconds) and resumed.seconds > seconds[-1], "the clock goes on too"


def test_a_cloud_that_has_grown_goes_on_growing(tmp_path):
    scan, path, growing = cone(17, 24), tmp_path / "fit.npz", LONG | {"growth": 2.5}
    whole = reconstruct(scan, settings=growing)
    counts = [record["gaussians"] for record in whole.history]
    assert counts[1] == counts[0] + math.ceil(0.5 * counts[0])
    assert counts[1] < counts[2] < counts[3] == counts[4] == math.floor(2.5 * counts[0])
    killed_after(2, scan, path, settings=growing)
    resumed = reconstruct(scan, settings=growing, checkpoint=path, resume=True)
    assert np.array_equal(resumed.volume, whole.volume)
    assert without_seconds(resumed.history) == without_seconds(whole.history)


def test_the_start_volume_is_made_once(killed, monkeypatch):
    def again(*_):
        raise AssertionError("the start volume was made again")

    monkeypatch.setattr("tomo_polysplat.plan.preparation.first_volume", again)
    assert "passes" in reconstruct(fan(), checkpoint=killed, resume=True, settings=LONG).plan["stop"].why


def test_resuming_a_finished_run_only_makes_the_volume(tmp_path):
    path = tmp_path / "fit.npz"
    patient = {"settings": QUICK | {"passes": 40.0, "patience": 1}}
    whole = reconstruct(fan(), checkpoint=path, **patient)
    assert "held-out" in whole.plan["stop"].why and len(whole.history) < 40
    seen = []
    again = reconstruct(fan(), checkpoint=path, resume=True, callbacks=[seen.append], **patient)
    assert not seen and np.array_equal(again.volume, whole.volume) and again.plan == whole.plan


def test_a_run_that_a_callback_ended_goes_on(tmp_path):
    path, whole = tmp_path / "fit.npz", uninterrupted()
    paused = reconstruct(fan(), settings=LONG, checkpoint=path, callbacks=[lambda state: state.share > 0.3])
    assert "callback" in paused.plan["stop"].why and len(paused.history) == 2
    resumed = reconstruct(fan(), settings=LONG, checkpoint=path, resume=True)
    assert np.array_equal(resumed.volume, whole.volume)


def test_the_time_budget_counts_both_parts(tmp_path):
    """A first part that took 2000 s leaves nothing of a budget of 1000 s."""
    path, options = tmp_path / "fit.npz", {"settings": LONG, "time_budget": 1000.0}
    killed_after(1, fan(), path, **options)
    rewritten(path, about=with_numbers(path, seconds=2000.0))
    resumed = reconstruct(fan(), checkpoint=path, resume=True, **options)
    assert "time budget" in resumed.plan["stop"].why and len(resumed.history) == 1
    assert resumed.seconds > 2000


def test_resume_begins_anew_without_a_file_and_checkpoint_never_replaces_one(tmp_path):
    path = tmp_path / "fit.npz"
    reconstruct(fan(), checkpoint=path, resume=True)
    before = path.read_bytes()
    with pytest.raises(FileExistsError, match="resume=True"):
        reconstruct(fan(), checkpoint=path)
    assert path.read_bytes() == before and os.listdir(tmp_path) == ["fit.npz"]
    with pytest.raises(ValueError, match="resume: expected a checkpoint"):
        reconstruct(fan(), resume=True)


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"seed": 5}, "'seed': 5"),
        ({"settings": LONG | {"tv_weight": 0.5}}, "'tv_weight': 0.5"),
        ({"time_budget": 100.0}, "time_budget"),
        ({"unit": "mm"}, "another scan"),
        ({"spectrum": None}, "another scan"),
        ({"materials": ("pmma", "aluminium", "iron")}, "another scan"),
    ],
)
def test_another_run_is_refused(killed, change, named):
    with pytest.raises(ValueError, match=named):
        reconstruct(fan(), checkpoint=killed, resume=True, **({"settings": LONG} | change))


def test_a_single_other_ray_is_another_scan(killed):
    projections = fan().projections.copy()
    projections[0, 3, 5] = np.nextafter(projections[0, 3, 5], np.float32(9))
    with pytest.raises(ValueError, match="another scan"):
        reconstruct(fan(), projections, checkpoint=killed, resume=True, settings=LONG)


def rewritten(path, **changes):
    with np.load(path) as file:
        arrays = dict(file)
    np.savez(path, **{name: value for name, value in (arrays | changes).items() if value is not None})


def test_a_compressed_checkpoint_is_refused(tmp_path):
    """It is never written so, and could unpack to a thousand times its size."""
    path = tmp_path / "fit.npz"
    reconstruct(fan(), checkpoint=path)
    with np.load(path) as file:
        arrays = dict(file)
    np.savez_compressed(path, **arrays)
    with pytest.raises(ValueError, match="expected a stored array"):
        reconstruct(fan(), checkpoint=path, resume=True)


def with_numbers(path, part="numbers", **changes):
    with np.load(path) as file:
        about = json.loads(file["about"].tobytes())
    (about if part is None else about[part]).update(changes)
    return np.frombuffer(json.dumps(about).encode(), np.uint8)


def with_huge(path, name):
    """One number is finite, and its square is not."""
    with np.load(path) as file:
        array = file[name]
    array.reshape(-1)[0] = 1e38
    return array


def with_answer(path, **values):
    with np.load(path) as file:
        about = json.loads(file["about"].tobytes())
    for name, value in values.items():
        about["plan"]["answers"][name]["value"] = value
    return np.frombuffer(json.dumps(about).encode(), np.uint8)


def with_answers(path, **answers):
    with np.load(path) as file:
        about = json.loads(file["about"].tobytes())
    about["plan"]["answers"] |= answers
    return np.frombuffer(json.dumps(about).encode(), np.uint8)


def with_fact(path, name, **parts):
    with np.load(path) as file:
        about = json.loads(file["about"].tobytes())
    fact = {"value": 0.0, "why": "", "status": "asked", "evidence": {"asked": 1.0}}
    about["plan"]["facts"][name] = fact | parts
    return np.frombuffer(json.dumps(about).encode(), np.uint8)


def test_what_a_plan_does_not_know_is_refused_by_name(killed):
    """Nothing would read it: who set it meant something else."""
    path = killed
    with np.load(path) as file:
        answer = json.loads(file["about"].tobytes())["plan"]["answers"]["seed_spacing"]
    whole = path.read_bytes()
    for changed, word in (
        (lambda: with_numbers(path, "plan", reference=1e300), "answers and facts, got reference"),
        (lambda: with_answers(path, spacing=answer), "known questions, got one to spacing"),
    ):
        rewritten(path, about=changed())
        with pytest.raises(ValueError, match=word):
            reconstruct(fan(), checkpoint=path, resume=True, settings=LONG)
        path.write_bytes(whole)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: path.write_bytes(path.read_bytes()[:-100]),
        lambda path: path.write_bytes(b"not an archive"),
        lambda path: rewritten(path, pull=None),
        lambda path: rewritten(path, pull=np.zeros(3, np.float32)),
        lambda path: rewritten(path, **{"gaussians/position": np.full((4, 3), np.nan, np.float32)}),
        lambda path: rewritten(path, **{"gaussians/own_material": with_huge(path, "gaussians/own_material")}),
        lambda path: rewritten(path, **{"gaussians/group": np.array([2**40])}),
        lambda path: rewritten(path, order=np.array([10**6])),
        lambda path: rewritten(path, order=np.array([{}], dtype=object)),
        lambda path: rewritten(path, about=np.frombuffer(b"[" * 100_000, np.uint8)),
        lambda path: rewritten(path, about=np.frombuffer(b"{}", np.uint8)),
        lambda path: rewritten(path, about=with_numbers(path, steps=-1)),
        lambda path: rewritten(path, about=with_numbers(path, None, numbers="none")),
        lambda path: rewritten(path, about=with_numbers(path, random={"bit_generator": "MT19937"})),
        lambda path: rewritten(path, about=with_numbers(path, seconds=float("nan"))),
        lambda path: rewritten(path, about=with_numbers(path, largest=["much", 1.0])),
        lambda path: rewritten(path, about=with_numbers(path, history=[1])),
        lambda path: rewritten(path, about=with_numbers(path, history=[{"loss": 0.1}])),
        lambda path: rewritten(path, about=with_numbers(path, history=[{"loss": "low", "held_out": None}])),
        lambda path: rewritten(path, about=with_answer(path, tv_corner=[0.1])),
        lambda path: rewritten(path, about=with_answer(path, soft_reference=1.0)),
        lambda path: rewritten(path, about=with_answer(path, seed_spacing=1e30)),
        lambda path: rewritten(path, about=with_answer(path, curves=True)),
        lambda path: rewritten(path, about=with_numbers(path, stop=["tired", "of it"])),
        lambda path: rewritten(path, about=with_fact(path, "drift", evidence={"asked": "often"})),
        lambda path: rewritten(path, about=with_fact(path, "gains", evidence={"rms": float("nan")})),
        lambda path: rewritten(path, about=with_fact(path, "gains", value="some")),
        lambda path: rewritten(path, about=with_answer(path, tv_corner=["a", "tenth"])),
    ],
)
def test_a_damaged_file_is_refused(killed, damage):
    damage(killed)
    with pytest.raises(ValueError, match="checkpoint|path|order"):
        reconstruct(fan(), checkpoint=killed, resume=True, settings=LONG)


def test_nothing_in_the_file_is_pickled(killed):
    with np.load(killed, allow_pickle=False) as file:
        assert all(file[name].dtype.kind in "fiu" for name in file.files) and len(file.files) > 20
    with zipfile.ZipFile(killed) as archive:
        assert archive.testzip() is None


def test_a_disk_that_fills_up_ends_no_run(tmp_path, monkeypatch, caplog):
    path = tmp_path / "fit.npz"

    def full(folder, needed):
        raise OSError("No space left on device")

    monkeypatch.setattr("tomo_polysplat.files.require_room", full)
    result = reconstruct(fan(), checkpoint=path)
    assert "passes" in result.plan["stop"].why and "No space left" in caplog.text and not path.exists()


def test_writing_takes_a_small_share_of_the_time(tmp_path, monkeypatch):
    """With a clock of its own: passes of 1 s, files that take 0.13 s to write."""
    import tomo_polysplat.plan.checkpoint as module

    now, written = [100.0], []
    monkeypatch.setattr(module, "_LARGEST_SHARE", 0.05)
    monkeypatch.setattr(module.time, "perf_counter", lambda: now[0])
    keeper = Checkpoint.__new__(Checkpoint)
    keeper.path, keeper._written, keeper._took = tmp_path / "fit.npz", 0.0, 0.0

    def write(snapshot):
        now[0] += 0.13
        written.append(snapshot)

    monkeypatch.setattr(keeper, "_write", write)
    for number in range(20):
        now[0] += 1.0
        keeper.offer(lambda number=number: number, now=False)
    assert written == [0, 3, 6, 9, 12, 15, 18]
    keeper.offer(lambda: "last", now=True)
    assert written[-1] == "last"

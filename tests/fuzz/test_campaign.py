"""The fault campaign sees the faults that it is to see, and tells of them."""

import json
import os
import random
import sys
import time
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
pytest.importorskip("fcntl")

from tests.campaign import files, kills  # noqa: E402
from tests.campaign.__main__ import main  # noqa: E402
from tests.campaign.forks import FAILED, child  # noqa: E402
from tests.campaign.record import Record  # noqa: E402
from tests.campaign.worker import observed  # noqa: E402
from tests.campaign.writers import Writer  # noqa: E402

FAULTY = """
import json, os, sys, time
print("ready", flush=True)
for line in sys.stdin:
    task = json.loads(line)
    print("begun", flush=True)
    if task["seed"] == "0.1":
        os.abort()
    print(json.dumps({"accepted": True, "found": None, "seconds": 0.1, "bytes": 5}), flush=True)
    print("done", flush=True)
"""


def test_a_worker_that_ends_is_counted_and_started_again(tmp_path, monkeypatch):
    worker = tmp_path / "worker.py"
    worker.write_text(FAULTY)
    monkeypatch.setattr(files, "WORKER", worker)
    monkeypatch.setattr(files, "BATCH", 1)
    record = Record()
    files.hostile_files(record, 0, 3, time.monotonic() + 30, ["EDF"])
    assert record.rows == {"file: EDF": {"tried": 3, "accepted": 2, "crashed": 1}}
    assert "seed 0.1" in record.findings[0]


@pytest.mark.parametrize(
    ("action", "column"),
    [
        (lambda *_: 1 / 0, "no words"),
        (lambda *_: len(bytearray(1100 * 2**20)), "over memory"),
        (lambda *_: True, None),
    ],
)
def test_what_a_case_took_and_did_is_noted(action, column, tmp_path):
    def bounded():
        record = Record()
        files._note(record, "EDF", "1", observed(action, None, tmp_path))
        return int(record.rows["file: EDF"].get(column, 0) != 1 if column else bool(record.findings))

    assert child(bounded) == 0


def test_a_writer_that_mixes_and_one_that_loses_are_seen(tmp_path):
    def in_place(path, state):
        with open(path, "w") as file:
            for _ in range(50):
                file.write(str(state))
                file.flush()
                time.sleep(0.001)

    def never(path, state):
        path.unlink(missing_ok=True)
        time.sleep(0.05)
        path.write_text(str(state))

    for number, (write, column) in enumerate(((in_place, "mixed"), (never, "lost"))):
        record = Record()
        part = kills._Killed(Writer(f"faulty {number}", write), tmp_path, record, random.Random(0))
        # A busy machine may kill after the end: so often at most.
        for _ in range(60):
            part.once()
            if record.rows.get(f"kill: faulty {number}", {}).get(column, 0):
                break
        assert record.rows[f"kill: faulty {number}"].get(column, 0) > 0


def test_a_child_s_end_is_told():
    assert child(lambda: 7) == 7
    assert child(lambda: os.kill(os.getpid(), 9)) == -9
    assert child(lambda: (sys.stderr.close(), 1 / 0)[1]) == FAILED


def test_a_short_campaign_adds_to_its_record(tmp_path, monkeypatch, capsys):
    path = tmp_path / "record.json"
    options = ["--only", "kills,disks", "--kills", "8", "--disks", "4"]
    options += ["--kinds", "result h5,result stack/,result nii.gz,scan npz", "--record", str(path)]
    path.write_text(
        json.dumps({"rows": {"kill: scan npz": {"tried": 7}}, "slowest": 0, "most": 0, "seconds": 1})
    )
    monkeypatch.setattr(sys, "argv", ["campaign", *options])
    status, told = main(), capsys.readouterr().out
    assert status == 0, told
    record = Record(path)
    assert record.total("kill", "tried") == 7 + 8 and record.rows["kill: scan npz"]["tried"] > 7
    assert record.total("quota", "tried") + record.total("disk", "tried") == 4
    assert "| scan npz | " in told and "| **all** | **15** | " in told
    assert "Faults: none." in told

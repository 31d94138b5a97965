"""Many hostile inputs under watch: ``python tests/fuzz/campaign.py 10000``.

Every target runs in processes of its own that may take 1 GB more memory than they start with and 5 s an input.
Prints how many inputs were accepted and refused, the slowest, and the memory; lists what was found, and ends with
status 1 if that is anything.
"""

from __future__ import annotations

import argparse
import faulthandler
import json
import random
import resource
import subprocess
import sys
import tempfile
import time
import traceback
from pathlib import Path

SECONDS, BYTES, BATCH = 5, 2**30, 500


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("inputs", type=int, nargs="?", default=10_000)
    parser.add_argument("--only", metavar="TARGET", help="one target instead of all")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.worker:
        print(json.dumps(work(arguments.only, arguments.inputs, arguments.seed)))
        return 0
    from targets import TARGETS

    names = [arguments.only] if arguments.only else list(TARGETS)
    found = {}
    for name in names:
        found |= watch(name, -(-arguments.inputs // len(names)), arguments.seed)
    for place, trace in found.items():
        print(f"\n--- {place}\n{trace}")
    print(f"\n{len(found)} findings")
    return 1 if found else 0


def watch(name: str, inputs: int, seed: int) -> dict[str, str]:
    """Run a target over so many inputs, and print a line about it; what was found, by its place."""
    total = {"inputs": 0, "accepted": 0, "slowest": 0.0, "megabytes": 0.0}
    found, begun = {}, time.monotonic()
    for number, start in enumerate(range(0, inputs, BATCH)):
        command = [sys.executable, __file__, str(min(BATCH, inputs - start)), "--only", name]
        command += ["--seed", str(seed * 1000 + number), "--worker"]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            kind = f"signal {-done.returncode}" if done.returncode < 0 else "a hang or an abort"
            last = [line[:200] for line in done.stderr.splitlines()[-25:]]
            found[f"{name}, seed {seed * 1000 + number}: {kind}"] = "\n".join(last)
            continue
        report = json.loads(done.stdout.splitlines()[-1])
        found |= report.pop("found")
        for key, value in report.items():
            total[key] = total[key] + value if key in ("inputs", "accepted") else max(total[key], value)
    print(
        f"{name:14} {total['inputs']:6} inputs, {total['accepted']:5} accepted, slowest {total['slowest']:.2f} s,"
        f" {total['megabytes']:.0f} MB more, {time.monotonic() - begun:.0f} s in all",
        flush=True,
    )
    return found


def work(name: str, inputs: int, seed: int) -> dict:
    """One process: the target over so many inputs."""
    from hypothesis import HealthCheck, Phase, given, settings
    from hypothesis import seed as seeded
    from targets import TARGETS

    from tomo_polysplat.physics.materials import mass_attenuation

    target, cases = TARGETS[name]
    report = {"inputs": 0, "accepted": 0, "slowest": 0.0, "megabytes": 0.0, "found": {}}
    mass_attenuation("iron", 60.0)  # loads its tables, which takes seconds once
    before = limit_memory()

    with tempfile.TemporaryDirectory() as folder:

        @seeded(random.Random(f"{name} {seed}").getrandbits(64))
        @settings(
            max_examples=inputs,
            deadline=None,
            database=None,
            phases=[Phase.generate],
            suppress_health_check=list(HealthCheck),
        )
        @given(cases)
        def run(case):
            begun = time.monotonic()
            faulthandler.dump_traceback_later(SECONDS, exit=True)
            try:
                report["accepted"] += target(case, Path(folder))
            except Exception as error:
                place = traceback.extract_tb(error.__traceback__)[-1]
                cause = error.__context__ or error
                inner = traceback.extract_tb(cause.__traceback__)[-1]
                where = f"{name}: {type(cause).__name__} at {Path(inner.filename).name}:{inner.lineno}"
                report["found"].setdefault(f"{where} ({place.name})", traceback.format_exc()[-2500:])
            finally:
                faulthandler.cancel_dump_traceback_later()
            report["inputs"] += 1
            report["slowest"] = max(report["slowest"], time.monotonic() - begun)

        run()
    report["megabytes"] = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 - before) / 2**20
    return report


def limit_memory() -> int:
    """Allow this process `BYTES` more than it has; what it holds now."""
    pages = Path("/proc/self/statm").read_text(encoding="ascii").split()
    virtual, resident = (int(number) * resource.getpagesize() for number in pages[:2])
    resource.setrlimit(resource.RLIMIT_AS, (virtual + BYTES, virtual + BYTES))
    return resident


if __name__ == "__main__":
    sys.exit(main())

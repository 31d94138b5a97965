"""Compare this tree with another commit, bit for bit: ``python scripts/same_as.py BASE [--record FILE] [CASE ...]``.

Both reconstruct the tiny scans of ``same_as_cases.py`` on this machine, on one thread, and the SHA-256 of volumes,
Gaussians and histories (without seconds) are compared. ``--record`` keeps those of BASE for the next comparison.
Exit status 1 where anything differs.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
CASES = Path(__file__).with_name("same_as_cases.py")


def digests(tree: Path, cases: list[str]) -> dict[str, dict[str, str]]:
    """What the cases come to in a tree."""
    fixed = dict.fromkeys(("OMP_NUM_THREADS", "NUMBA_NUM_THREADS", "MKL_NUM_THREADS"), "1")
    environment = os.environ | fixed | {"PYTHONPATH": str(tree), "SAME_AS_TREE": str(tree)}
    command = [sys.executable, str(CASES), *cases]
    # Numba's cache does not see that a function which is called from another file has changed.
    with tempfile.TemporaryDirectory() as cache:
        environment["NUMBA_CACHE_DIR"] = cache
        done = subprocess.run(
            command, env=environment, cwd=tree, stdout=subprocess.PIPE, text=True, check=True
        )
    return json.loads(done.stdout.splitlines()[-1])


def of_commit(base: str, cases: list[str]) -> dict[str, dict[str, str]]:
    """What they come to in a worktree of a commit, which is removed afterwards."""
    with tempfile.TemporaryDirectory() as folder:
        tree = Path(folder) / "base"
        subprocess.run(["git", "worktree", "add", "--quiet", "--detach", tree, base], cwd=ROOT, check=True)
        try:
            return digests(tree, cases)
        finally:
            subprocess.run(["git", "worktree", "remove", "--force", tree], cwd=ROOT, check=True)


def main() -> int:
    """Compare and print a line a case."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("base", help="commit to compare with")
    parser.add_argument("cases", nargs="*", help="all by default")
    parser.add_argument("--record", type=Path, help="file that keeps the digests of the base")
    asked = parser.parse_args()
    known = json.loads(asked.record.read_text()) if asked.record and asked.record.exists() else {}
    commit = subprocess.run(
        ["git", "rev-parse", asked.base], cwd=ROOT, stdout=subprocess.PIPE, text=True, check=True
    ).stdout.strip()
    then = known.get(commit) or of_commit(asked.base, asked.cases)
    if asked.record:
        asked.record.write_text(json.dumps({commit: then}, indent=1) + "\n")
    now = digests(ROOT, asked.cases)
    differing = 0
    for name, found in now.items():
        other = [part for part, digest in found.items() if then.get(name, {}).get(part) != digest]
        differing += bool(other)
        print(f"{name:24s} {'differs in ' + ', '.join(other) if other else 'same'}")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())

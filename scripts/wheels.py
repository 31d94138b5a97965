"""Run the tests with the newest releases of every dependency, or with the oldest ones that pyproject.toml allows.

    python scripts/wheels.py newest
    python scripts/wheels.py oldest --torch torch==2.13.0 -- tests/scan tests/model -q -x

Each in a fresh virtual environment, without constraints.txt. The oldest release of a dependency is the first from its
lower bound on that the index holds a wheel of for this Python. ``--torch`` fixes torch, whose newest build may be
gigabytes. What follows ``--`` goes to pytest; nothing runs the whole suite.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from packaging.requirements import Requirement
from packaging.version import Version

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).resolve().parent.parent


def main() -> int:
    """The exit code of the tests, or 1 where an installation fails."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("which", choices=["newest", "oldest"])
    parser.add_argument("--torch", metavar="SPEC", help="a fixed torch, such as torch==2.13.0")
    own, _, tests = " ".join(sys.argv[1:]).partition(" -- ")
    arguments = parser.parse_args(own.split())
    with tempfile.TemporaryDirectory() as folder:
        python = Path(folder) / "venv" / ("Scripts" if sys.platform == "win32" else "bin") / "python"
        subprocess.run([sys.executable, "-m", "venv", python.parent.parent], check=True)
        pins = [arguments.torch] if arguments.torch else []
        if arguments.which == "oldest":
            pins += [pin for pin in map(_oldest, _requirements()) if not (pins and pin.startswith("torch=="))]
        constraints = Path(folder) / "pins.txt"
        constraints.write_text("\n".join(pins) + "\n", encoding="utf-8")
        print("\n".join(pins) or "newest", flush=True)
        install = [python, "-m", "pip", "install", "-c", constraints, "-e", f"{ROOT}[test]"]
        done = subprocess.run(install, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        if done.returncode:
            print(done.stdout[done.stdout.find("ERROR") :])
            return 1
        subprocess.run([python, "-m", "pip", "list", "--format=freeze"], check=True)
        wanted = tests.split() or ["-n", "2", "--dist", "loadfile"]
        return subprocess.run([python, "-m", "pytest", *wanted], cwd=ROOT).returncode


def _requirements() -> list[Requirement]:
    """Those of the package and of its tests that this Python needs and that have a lower bound."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = project["dependencies"] + project["optional-dependencies"]["test"]
    wanted = [Requirement(line) for line in lines]
    return [each for each in wanted if each.specifier and (each.marker is None or each.marker.evaluate())]


def _oldest(requirement: Requirement) -> str:
    """The oldest release that is allowed and that there is a wheel of, as ``name==version``."""
    name = requirement.name
    listed = _pip("index", "versions", name)
    found = re.search(r"Available versions: (.*)", listed.stdout)
    if found is None:
        raise SystemExit(f"the index does not list {name}: {listed.stderr.strip()}")
    for version in sorted(map(Version, found.group(1).split(", "))):
        pin = f"{name}=={version}"
        asked = (
            "install",
            "-q",
            "--dry-run",
            "--ignore-installed",
            "--no-deps",
            "--only-binary",
            ":all:",
            pin,
        )
        if version in requirement.specifier and _pip(*asked).returncode == 0:
            return pin
    raise SystemExit(f"no wheel of {requirement} for this Python")


def _pip(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-m", "pip", *arguments], capture_output=True, text=True)


if __name__ == "__main__":
    sys.exit(main())

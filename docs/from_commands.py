"""What the commands of the docs print, by running them at each build, and a picture of what they make."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

__all__ = ["make"]

_MAIN = "import sys; from tomo_polysplat.cli import main; sys.exit(main())"
_FOLDER = ("python", "-m", "tomo_polysplat.simulate.folders", "skyscan", "my_scan")
_COMMANDS = (
    _FOLDER,
    ("tomo-polysplat", "import", "my_scan/", "-o", "scan.h5"),
    ("tomo-polysplat", "recon", "scan.h5", "-o", "volume.tif", "--quality", "fast"),
)
_DEMO = ("tomo-polysplat", "demo", "--overwrite")
_RESULT = ("tomo-polysplat", "recon", "scan.h5", "-o", "result.h5", "--quality", "fast")
_VIEW = ("tomo-polysplat", "view", "result.h5", "--scan", "scan.h5", "--no-browser")
_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")
# Of a line of output that is shown.
_WIDTH = 150


def make(folder: Path) -> None:
    """Write what commands print, as ``commands.txt``, ``demo.txt`` and ``view.txt``, and pictures of what they make.

    Without a browser the page of ``view`` is the picture that is stored beside this file.
    """
    with tempfile.TemporaryDirectory() as name:
        place = Path(name)
        (folder / "commands.txt").write_text(_printed(_COMMANDS, place), encoding="utf-8")
        _draw(place / "volume.tif", folder / "commands.png")
        shown = _printed((_RESULT,), place)
        with _running(_VIEW, place) as lines:
            (folder / "view.txt").write_text(f"{shown}\n{_told(_VIEW, lines)}", encoding="utf-8")
            _photograph(lines[0], folder / "view.png")
        (folder / "demo.txt").write_text(_printed((_DEMO,), place), encoding="utf-8")
        shutil.copy(place / "demo.png", folder / "demo.png")


def _printed(commands: tuple[tuple[str, ...], ...], place: Path) -> str:
    """Commands as they are typed, and what they print."""
    told = []
    for command in commands:
        done = subprocess.run(
            _real(command), cwd=place, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=True
        )
        told.append(_told(command, done.stdout.splitlines()))
    return "\n".join(told)


def _real(command: tuple[str, ...]) -> list[str]:
    if command[0] == "python":
        return [sys.executable, *command[1:]]
    return [sys.executable, "-c", _MAIN, *command[1:]]


def _told(command: tuple[str, ...], printed: list[str]) -> str:
    lines = [f"$ {' '.join(command)}", *printed]
    return "\n".join(line for text in lines for line in _broken(text)) + "\n"


@contextmanager
def _running(command: tuple[str, ...], place: Path) -> Iterator[list[str]]:
    """A command that waits for the end of the block; its first two lines."""
    with subprocess.Popen(_real(command), cwd=place, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield [process.stdout.readline().rstrip() for _ in range(2)]
        finally:
            process.terminate()


def _photograph(address: str, path: Path) -> None:
    browser = next((found for name in _BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        shutil.copy(Path(__file__).parent / "view.png", path)
        return
    # Its own folder, so that a browser that somebody uses is left alone.
    with tempfile.TemporaryDirectory() as profile:
        options = ("--headless", "--no-sandbox", "--disable-gpu", "--window-size=1300,760")
        own = (f"--user-data-dir={profile}", "--virtual-time-budget=8000", f"--screenshot={path}")
        subprocess.run([browser, *options, *own, address], capture_output=True, check=True, timeout=120)


def _broken(text: str) -> list[str]:
    """A long line in several, at blanks."""
    lines = []
    while len(text) > _WIDTH and (cut := text.rfind(" ", 8, _WIDTH)) > 0:
        lines.append(text[:cut])
        text = "    " + text[cut + 1 :]
    return [*lines, text]


def _draw(volume: Path, path: Path) -> None:
    """Slices through the marker."""
    import numpy as np
    import tifffile
    from matplotlib.figure import Figure

    stack = tifffile.imread(volume)
    z, y, x = np.unravel_index(int(np.argmax(stack)), stack.shape)
    figure = Figure(figsize=(7.4, 2.9), layout="constrained")
    planes = {"z": stack[z], "y": stack[:, y][::-1], "x": stack[:, :, x][::-1]}
    for axis, (name, plane) in zip(figure.subplots(1, 3), planes.items()):
        axis.imshow(plane, cmap="gray", vmin=0, vmax=float(np.quantile(stack, 0.999)))
        axis.set_title(f"slice across {name}", fontsize=9)
        axis.set_axis_off()
    figure.savefig(path, dpi=110)

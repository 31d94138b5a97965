"""What the commands of the docs print, by running them at each build, and a picture of what they make."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from pathlib import Path

__all__ = ["make"]

_MAIN = "import sys; from tomo_polysplat.cli import main; sys.exit(main())"
_FOLDER = ("python", "-m", "tomo_polysplat.simulate.folders", "skyscan", "my_scan")
_COMMANDS = (
    _FOLDER,
    ("tomo-polysplat", "import", "my_scan/", "-o", "scan.h5"),
    ("tomo-polysplat", "recon", "scan.h5", "-o", "volume.tif", "--quality", "fast"),
)
# Of a line of output that is shown.
_WIDTH = 150


def make(folder: Path) -> None:
    """Write ``commands.txt`` and ``commands.png`` into a folder."""
    with tempfile.TemporaryDirectory() as place:
        shown = [_shown(command, Path(place)) for command in _COMMANDS]
        (folder / "commands.txt").write_text("\n".join(shown), encoding="utf-8")
        _draw(Path(place) / "volume.tif", folder / "commands.png")


def _shown(command: tuple[str, ...], place: Path) -> str:
    """A command as it is typed, and what it prints."""
    real = [sys.executable, *command[1:]]
    if command[0] != "python":
        real = [sys.executable, "-c", _MAIN, *command[1:]]
    done = subprocess.run(
        real, cwd=place, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, check=True
    )
    lines = [f"$ {' '.join(command)}", *done.stdout.splitlines()]
    return "\n".join(line for text in lines for line in _broken(text)) + "\n"


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
    figure = Figure(figsize=(7.4, 2.6), layout="constrained")
    planes = {"z": stack[z], "y": stack[:, y][::-1], "x": stack[:, :, x][::-1]}
    for axis, (name, plane) in zip(figure.subplots(1, 3), planes.items()):
        axis.imshow(plane, cmap="gray", vmin=0, vmax=float(np.quantile(stack, 0.999)))
        axis.set_title(f"slice across {name}", fontsize=9)
        axis.set_axis_off()
    figure.savefig(path, dpi=110)

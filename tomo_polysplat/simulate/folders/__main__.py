"""``python -m tomo_polysplat.simulate.folders KIND FOLDER``: a tiny folder as a scanner of that kind writes it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tomo_polysplat.simulate.folders.write import KINDS, scan_for, write_folder

__all__ = ["main"]

_SIZE = {"views": 48, "rows": 33, "columns": 37, "seed": 0}


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(prog="python -m tomo_polysplat.simulate.folders", description=__doc__)
    parser.add_argument("kind", choices=list(KINDS), metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="a new folder")
    for name, usual in _SIZE.items():
        parser.add_argument(f"--{name}", type=int, default=usual, metavar="N", help=f"default: {usual}")
    arguments = parser.parse_args()
    size = {name: getattr(arguments, name) for name in _SIZE}
    write_folder(arguments.kind, arguments.folder, scan_for(arguments.kind, **size))
    return 0


if __name__ == "__main__":
    sys.exit(main())

"""``python -m tomo_polysplat.simulate.folders KIND FOLDER``: a tiny folder as a scanner of that kind writes it."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from tomo_polysplat.simulate.folders.write import KINDS, write_folder

__all__ = ["main"]


def main() -> int:
    """Entry point."""
    parser = argparse.ArgumentParser(prog="python -m tomo_polysplat.simulate.folders", description=__doc__)
    parser.add_argument("kind", choices=list(KINDS), metavar="KIND", help=", ".join(KINDS))
    parser.add_argument("folder", type=Path, metavar="FOLDER", help="a new folder")
    arguments = parser.parse_args()
    write_folder(arguments.kind, arguments.folder)
    return 0


if __name__ == "__main__":
    sys.exit(main())

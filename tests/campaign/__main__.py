"""Faults on purpose: ``python -m tests.campaign --minutes 10``, in the folder of the repository.

Kills in the middle of writing, disks that fill up, damaged and lying files, and other numbers of threads. Prints a
table of what was tried and what came of it, and ends with status 1 if there was a fault. The same seed tries the same
files. ``--only kills,disks`` chooses parts; ``--files 1000`` and the like say how often; ``--record FILE`` adds the
counts to those of earlier runs. It needs Unix, and Linux for the disks of its own. It needs the extra ``test``.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from .record import FAULTS, Record

PARTS = ("threads", "kills", "disks", "files")
# Of the time that is left when a part begins.
SHARES = {"threads": 1.0, "kills": 0.3, "disks": 0.2, "files": 1.0}
MANY = 10**6


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.campaign", description=__doc__.splitlines()[0])
    parser.add_argument("--minutes", type=float, default=10.0, help="of the clock, in all (default: 10)")
    parser.add_argument("--only", default=",".join(PARTS), metavar="PARTS", help=f"some of {','.join(PARTS)}")
    for part in PARTS[1:]:
        parser.add_argument(f"--{part}", type=int, default=MANY, metavar="N", help=f"{part} to try at most")
    parser.add_argument("--seed", type=int, default=0, help="another one tries others (default: 0)")
    parser.add_argument("--kinds", metavar="NAMES", help="kinds of files or of writers, between commas")
    parser.add_argument("--record", type=Path, metavar="FILE", help="add the counts to this file (.json)")
    arguments = parser.parse_args()
    chosen = [part for part in PARTS if part in arguments.only.split(",")]
    if not chosen:
        parser.error(f"--only: expected some of {', '.join(PARTS)}, got {arguments.only}")
    record, begun = Record(arguments.record), time.monotonic()
    end = begun + 60 * arguments.minutes
    try:
        for part in chosen:
            now = time.monotonic()
            share = SHARES[part] if part != chosen[-1] else 1.0
            run(part, record, arguments, now + share * (end - now))
    except KeyboardInterrupt:
        print("interrupted: what was tried so far")
    record.seconds += time.monotonic() - begun
    record.save()
    for found in record.findings[:40]:
        print(f"--- {found}\n")
    print(f"{record.table()}\n\n{record.conditions()}")
    return 1 if any(row.get(fault) for row in record.rows.values() for fault in FAULTS) else 0


def run(part: str, record: Record, arguments: argparse.Namespace, until: float) -> None:
    """One part, until the clock says so."""
    kinds = arguments.kinds.split(",") if arguments.kinds else None
    if part == "threads":
        from .threads import the_same_bits

        the_same_bits(record)
    elif part == "files":
        from .files import hostile_files

        hostile_files(record, arguments.seed, arguments.files, until, kinds)
    elif part == "kills":
        from .kills import kills

        kills(record, arguments.seed, arguments.kills, until, kinds)
    else:
        from .disks import full_disks

        full_disks(record, arguments.seed, arguments.disks, until, kinds)


if __name__ == "__main__":
    sys.exit(main())

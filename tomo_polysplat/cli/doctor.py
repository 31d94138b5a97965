"""``tomo-polysplat doctor``: what this machine can do."""

from __future__ import annotations

import argparse
import logging
from collections.abc import Iterator
from contextlib import contextmanager

NAME = "doctor"
HELP = "say which versions, devices and kernels are there and why, and test them"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    parser.add_argument("--no-test", action="store_true", help="leave out the self-test")
    parser.add_argument(
        "--warm",
        action="store_true",
        help="compile all kernels now, so that no later run has to wait for them",
    )


def run(arguments: argparse.Namespace) -> int:
    """Print the findings; the exit status is 1 when the self-test fails."""
    from tomo_polysplat.doctor import findings, self_test, warm

    for heading, lines in findings():
        print(heading)
        for name, text in lines:
            print(f"  {name:<16} {text}")
    with _errors_alone():
        if arguments.warm:
            print(f"kernels\n  {'compiled':<16} {warm()}")
        if arguments.no_test:
            return 0
        passed, text = self_test()
    print(f"self-test\n  {'passed' if passed else 'FAILED':<16} {text}")
    return 0 if passed else 1


@contextmanager
def _errors_alone() -> Iterator[None]:
    """What is wrong with the small scans of this command is nobody's concern, unless it ends them."""
    logger = logging.getLogger("tomo_polysplat")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)

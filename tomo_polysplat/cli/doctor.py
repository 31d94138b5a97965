"""``tomo-polysplat doctor``: what this machine can do."""

from __future__ import annotations

import argparse

NAME = "doctor"
HELP = "say which versions, devices and kernels are there and why, and test them"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    parser.add_argument("--no-test", action="store_true", help="leave out the self-test")


def run(arguments: argparse.Namespace) -> int:
    """Print the findings; the exit status is 1 when the self-test fails."""
    from tomo_polysplat.doctor import findings, self_test

    for heading, lines in findings():
        print(heading)
        for name, text in lines:
            print(f"  {name:<16} {text}")
    if arguments.no_test:
        return 0
    passed, text = self_test()
    print(f"self-test\n  {'passed' if passed else 'FAILED':<16} {text}")
    return 0 if passed else 1

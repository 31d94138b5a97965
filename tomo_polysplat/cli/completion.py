"""``tomo-polysplat completion``: what lets a shell complete commands, options and names of files."""

from __future__ import annotations

import argparse

from tomo_polysplat.checks import fail

NAME = "completion"
HELP = 'print what lets a shell complete this command: eval "$(tomo-polysplat completion bash)"'
SHELLS = ("bash", "zsh", "tcsh")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    parser.add_argument("shell", choices=SHELLS, metavar="SHELL", help=", ".join(SHELLS))


def run(arguments: argparse.Namespace) -> int:
    """Print the script."""
    try:
        import shtab
    except ImportError as error:
        remedy = "python -m pip install 'tomo-polysplat[completion]'"
        raise fail("completion", "shtab, which writes the script", "none", remedy, ImportError) from error
    _complete_files(arguments.whole, shtab.FILE)
    print(shtab.complete(arguments.whole, shell=arguments.shell))
    return 0


def _complete_files(parser: argparse.ArgumentParser, files: object) -> None:
    """Let every argument that is free be completed by names of files."""
    for action in parser._actions:
        if isinstance(action, argparse._SubParsersAction):
            for child in set(action.choices.values()):
                _complete_files(child, files)
        elif action.nargs != 0 and action.choices is None and action.type not in (int, float):
            action.complete = files  # type: ignore[attr-defined]

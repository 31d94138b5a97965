"""Parse the command line, run one subcommand, turn exceptions into exit codes."""

from __future__ import annotations

import functools
import logging
import os
import sys
from collections.abc import Container, Sequence

import tomo_polysplat
from tomo_polysplat.checks import visible
from tomo_polysplat.cli import bench, check, completion, demo, doctor, import_scan, recon, simulate, view
from tomo_polysplat.cli.options import INTERRUPTED, in_options
from tomo_polysplat.cli.parser import Parser
from tomo_polysplat.quiet_imports import ending_quickly

__all__ = ["main"]

COMMANDS = (demo, import_scan, recon, view, simulate, check, bench, doctor, completion)
BAD_INPUT, FAILED = 2, 1
# Who says what a scanner's folder does not tell, and by which name of `scanner` a user can.
_OF_FOLDERS = "tomo_polysplat.scan.readers"
# What a shell tells of a command whose reader went away.
UNREAD = 128 + 13


def main(argv: Sequence[str] | None = None) -> int:
    """Entry point.

    Returns
    -------
    int
        0 when all went well, 1 for a failure of ours, 2 for bad input, 130 when interrupted, 141 when nobody reads
        what is printed.
    """
    ending_quickly()
    arguments = build_parser().parse_all(argv)
    level = logging.DEBUG if arguments.debug else logging.INFO if arguments.verbose else logging.WARNING
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_VisibleFormatter(arguments.parser.options))
    handler.addFilter(_FirstTime())
    logging.basicConfig(level=level, handlers=[handler])
    if arguments.debug:
        return arguments.run(arguments)
    try:
        status = arguments.run(arguments)
        sys.stdout.flush()
        return status
    except BrokenPipeError:
        # Python flushes once more as it ends, and would tell of the pipe then.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return UNREAD
    except (ValueError, TypeError, OSError, MemoryError, ImportError) as error:
        return _complain(str(error) or type(error).__name__, BAD_INPUT)
    except KeyboardInterrupt as error:
        return _complain(str(error) or "interrupted", INTERRUPTED)
    except Exception as error:  # the last place where it can become one line
        return _complain(f"{type(error).__name__}: {error} (run again with --debug to see where)", FAILED)


@functools.cache
def build_parser() -> Parser:
    """The parser of every subcommand, which a process that calls `main` many times makes once."""
    parser = Parser(
        prog="tomo-polysplat",
        description="CT reconstruction with Gaussians of matter and the physics of a real x-ray spectrum: "
        "no metal or beam-hardening artefacts, no metal mask.",
    )
    parser.add_argument("--version", action="version", version=f"%(prog)s {tomo_polysplat.__version__}")
    common = Parser(add_help=False)
    common.add_argument("-v", "--verbose", action="store_true", help="say what is being done")
    common.add_argument("--debug", action="store_true", help="say everything, and show tracebacks")
    commands = parser.add_subparsers(metavar="COMMAND", required=True)
    for module in COMMANDS:
        child = commands.add_parser(
            module.NAME,
            parents=[common],
            help=module.HELP,
            description=f"{module.HELP[0].upper()}{module.HELP[1:]}.",
            examples=getattr(module, "EXAMPLES", ()),
        )
        module.add_arguments(child)
        child.set_defaults(run=module.run, parser=child, whole=parser)
    return parser


class _VisibleFormatter(logging.Formatter):
    """One line a message, or those of its own, even if texts from files have control characters in them.

    What `options` has of the names in hints is told as one types it.
    """

    def __init__(self, options: Container[str]) -> None:
        super().__init__("%(levelname)s: %(message)s")
        self._options = options

    def formatMessage(self, record: logging.LogRecord) -> str:  # noqa: N802  # its name in the library
        own = record.message.split("\n") if getattr(record, "has_own_lines", False) else [record.message]
        record.message = "\n".join(map(visible, own))
        if record.name.startswith(_OF_FOLDERS):
            record.message = in_options(record.message, self._options)
        return super().formatMessage(record)


class _FirstTime:
    """No warning twice: a scan is looked at several times, as start volumes are made anew."""

    def __init__(self) -> None:
        self._told: set[str] = set()

    def filter(self, record: logging.LogRecord) -> bool:
        """Whether it is to be shown."""
        if record.levelno != logging.WARNING:
            return True
        message = record.getMessage()
        first = message not in self._told
        self._told.add(message)
        return first


def _complain(message: str, code: int) -> int:
    print(f"tomo-polysplat: error: {' '.join(visible(message).split())}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())

"""An argument parser that says what is wrong first, and what was probably meant before all that is possible."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from tomo_polysplat.checks import did_you_mean, visible

__all__ = ["Parser"]


class Parser(argparse.ArgumentParser):
    """As in the library, but without abbreviations: those of today would mean something else tomorrow.

    Its help ends with `examples`, commands as they are typed.
    """

    def __init__(self, *args: Any, examples: Sequence[str] = (), **options: Any) -> None:
        super().__init__(*args, **({"allow_abbrev": False} | options))
        self._examples = tuple(examples)

    @property
    def options(self) -> tuple[str, ...]:
        """All that begins with hyphens, as it is typed."""
        return tuple(self._option_string_actions)

    def format_help(self) -> str:
        """All options, and the examples."""
        lines = "".join(f"  {one}\n" for one in self._examples)
        return super().format_help() + (f"\nexamples:\n{lines}" if lines else "")

    def parse_all(self, argv: Sequence[str] | None) -> argparse.Namespace:
        """The arguments of a command; what its own parser does not know ends it with a suggestion."""
        arguments, unknown = self.parse_known_args(argv)
        if unknown:
            parser = arguments.parser
            parser.error(f"unknown: {' '.join(unknown)}{_meant(unknown, parser._option_string_actions)}")
        return arguments

    def error(self, message: str) -> NoReturn:
        """What is wrong, and where to read on; the list of all options would push it off the screen."""
        print(f"{self.prog}: error: {visible(message)}", file=sys.stderr)
        self.exit(2, f"{self.prog} --help tells what there is.\n")

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is None or value in action.choices:
            return
        names = list(map(str, action.choices))
        meant = did_you_mean(value, names)
        words = f"{value!r}: {meant} " if meant else f"{value!r}: "
        raise argparse.ArgumentError(action, f"{words}expected one of {', '.join(names)}")

    def _get_value(self, action: argparse.Action, arg_string: str) -> Any:
        """What an option's text means; of a number that is none it is told what one looks like."""
        try:
            return super()._get_value(action, arg_string)  # type: ignore[misc]
        except argparse.ArgumentError:
            if action.type not in (float, int):
                raise
            expected = "a whole number" if action.type is int else "a number without a unit, such as 2.5"
            raise argparse.ArgumentError(action, f"expected {expected}, got {arg_string!r}") from None


def _meant(unknown: Sequence[str], options: Iterable[str]) -> str:
    """What the first unknown option was probably meant to be."""
    named = next((word.partition("=")[0] for word in unknown if word.startswith("--")), None)
    if named is None:
        return ""
    begun = [option for option in options if option.startswith(named)]
    meant = f"did you mean {' or '.join(begun)}?" if begun else did_you_mean(named, options)
    return f"; {meant}" if meant else ""

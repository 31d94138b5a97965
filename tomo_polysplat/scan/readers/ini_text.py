"""Texts of lines ``key = value`` in sections, as many scanners write them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

from tomo_polysplat.checks import fail, require_number, visible
from tomo_polysplat.scan.readers.text import number_of, text_of

__all__ = ["IniText"]

_MOST_BYTES = 1 << 22


class IniText:
    """Values by key, whatever the case of its letters and the blanks in it; remembers which were asked for.

    Parameters
    ----------
    path : Path
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._values: dict[str, tuple[str, str]] = {}
        self._asked: set[str] = set()
        section = ""
        for line in text_of(path, _MOST_BYTES).splitlines():
            text = line.strip()
            if text.startswith("[") and text.endswith("]"):
                section = text[1:-1].strip()
            elif "=" in text and not text.startswith((";", "#")):
                key, value = text.split("=", 1)
                # What is repeated later, by programs that came after the scanner, stands under its section alone.
                self._values.setdefault(_plain(key), (f"{section}/{key.strip()}", value.strip()))

    def __contains__(self, key: str) -> bool:
        return _plain(key) in self._values

    def text(self, *keys: str, otherwise: str = "") -> str:
        """The value of the first of these keys that there is."""
        for key in keys:
            if key in self:
                self._asked.add(_plain(key))
                return visible(self._values[_plain(key)][1])
        return otherwise

    def number(self, *keys: str, otherwise: float | None = None) -> float:
        """The first number in the value of the first of these keys that there is.

        Raises
        ------
        ValueError
            If there is none, unless `otherwise` is given.
        """
        text = self.text(*keys)
        number = number_of(text)
        if number is not None:
            return require_number(keys[0], number)
        if otherwise is not None:
            return otherwise
        got = f"{text!r}" if text else "none"
        raise fail("path", f"a number as '{keys[0]}' in {self._path.name}", got)

    def others(self) -> Mapping[str, str]:
        """What nobody has asked for."""
        return {name: value for plain, (name, value) in self._values.items() if plain not in self._asked}


def _plain(key: str) -> str:
    return re.sub(r"[\s/_]+", "", key).lower()

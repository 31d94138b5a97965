"""What a user sees in a folder."""

from __future__ import annotations

from pathlib import Path

__all__ = ["entries_of"]


def entries_of(folder: Path) -> list[Path]:
    """Files and folders in it by name, but for hidden ones.

    macOS leaves ``._name.tif`` beside ``name.tif`` on disks of other systems, which is no picture.
    """
    return sorted(entry for entry in folder.iterdir() if not entry.name.startswith("."))

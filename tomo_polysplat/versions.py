"""Versions of what is installed."""

from importlib import metadata

__all__ = ["installed_version"]


def installed_version(package: str) -> str | None:
    """Of a package by its name on PyPI; None where it is not installed."""
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return None

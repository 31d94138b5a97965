"""Forms of an array that must not matter."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np

from tomo_polysplat.bench.hard_cases.case import Case, Findings
from tomo_polysplat.bench.hard_cases.easy import fit, mono_slice, sound
from tomo_polysplat.bench.hard_cases.same import same_volume

__all__ = ["CASES"]


def _as(change: Callable[[np.ndarray], np.ndarray], device: str) -> Findings:
    """The same numbers in another form, and untouched afterwards."""
    scan = mono_slice()
    other = change(np.asarray(scan.projections))
    before = other.tobytes()
    result = fit(scan, device, other)
    findings, easy = sound(result), fit(scan, device, np.ascontiguousarray(other, np.float32))
    same_volume(findings, result.volume, easy.volume, device, "volume of float32 in C order")
    findings.equal("input unchanged", other.tobytes() == before, True)
    return findings


def _half(device: str) -> Findings:
    return _as(lambda array: array.astype(np.float16), device)


def _double(device: str) -> Findings:
    return _as(lambda array: array.astype(np.float64), device)


def _big_endian(device: str) -> Findings:
    return _as(lambda array: array.astype(">f4"), device)


def _fortran(device: str) -> Findings:
    return _as(np.asfortranarray, device)


def _strided(device: str) -> Findings:
    return _as(lambda array: np.repeat(array, 2, axis=2)[..., ::-2][..., ::-1], device)


def _mapped(device: str) -> Findings:
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
        path = Path(folder) / "projections.npy"
        np.save(path, mono_slice().projections)
        return _as(lambda array: np.load(path, mmap_mode="r"), device)


def _read_only(device: str) -> Findings:
    def frozen(array: np.ndarray) -> np.ndarray:
        copy = array.copy()
        copy.flags.writeable = False
        return copy

    return _as(frozen, device)


_WHY = "the same numbers give the same volume, bit by bit on a CPU"
CASES = (
    Case("float16", f"rounded first, then: {_WHY}", _half),
    Case("float64", _WHY, _double),
    Case("big-endian", _WHY, _big_endian),
    Case("fortran-order", _WHY, _fortran),
    Case("strided", _WHY, _strided),
    Case("memory-mapped", _WHY, _mapped),
    Case("read-only", _WHY, _read_only),
)

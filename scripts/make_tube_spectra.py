"""Make the tube tables that the package carries, with SpekPy (``pip install "tomo-polysplat[spectrum]"``).

    python scripts/make_tube_spectra.py [output.npz]

Model: SpekPy's default for reflection targets ("casim"), no filtration, on the central axis at 100 cm and 1
mAs. Bremsstrahlung and characteristic lines are stored apart, because they are interpolated between tube
voltages by different laws (see ``tomo_polysplat/physics/tube_tables.py``). Lines that fall in the same 1 keV
are merged at their mean energy.

SpekPy: G. Poludniowski et al., "Technical Note: SpekPy v2.0", Med. Phys. 48, 3630 (2021),
doi:10.1002/mp.14945.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import spekpy

ANODE_ANGLE = 12.0  # degrees
LINE_STEP = 0.1  # keV, fine enough to place the lines
LOW_GRID = [*range(20, 60, 2)]  # the shape changes fastest with voltage here
TUBES = {
    "W": LOW_GRID + [*range(60, 226, 5), *range(250, 451, 25)],
    **dict.fromkeys(("Mo", "Rh", "Ag", "Cu", "Au"), [*range(20, 51, 2)]),  # SpekPy's end at 50 kVp
}
# Lines that are merged are at their mean energy over these voltages.
MEAN_OVER = (30, 225)
OUTPUT = Path(__file__).resolve().parents[1] / "tomo_polysplat" / "physics" / "data" / "tube_spectra.npz"


def spectrum(anode: str, kvp: int, step: float, **parts: bool) -> tuple[np.ndarray, np.ndarray]:
    """Bin centres (keV) and fluence (photons per cm2, keV and mAs at 1 m)."""
    tube = spekpy.Spek(kvp=kvp, targ=anode, th=ANODE_ANGLE, dk=step, z=100.0, **parts)
    return tube.get_spectrum(edges=False)


def bremsstrahlung(anode: str, voltages: list[int]) -> np.ndarray:
    """``(voltages, bins)`` fluence per keV; bin k is centred on k + 0.5 keV, and bin 0 is empty."""
    table = np.zeros((len(voltages), max(voltages)), np.float32)
    for row, kvp in zip(table, voltages, strict=True):
        energies, fluence = spectrum(anode, kvp, 1.0, char=False)
        row[np.floor(energies).astype(int)] = fluence
    return table


def lines(anode: str, voltages: list[int]) -> tuple[np.ndarray, np.ndarray]:
    """Energies ``(lines,)`` in keV and photons ``(voltages, lines)`` of the characteristic lines."""
    counts = np.zeros((len(voltages), max(voltages)))
    moments = np.zeros_like(counts)
    for row, kvp in enumerate(voltages):
        energies, fluence = spectrum(anode, kvp, LINE_STEP, brem=False)
        np.add.at(counts[row], np.floor(energies).astype(int), fluence * LINE_STEP)
        np.add.at(moments[row], np.floor(energies).astype(int), fluence * LINE_STEP * energies)
    used = np.flatnonzero(counts.sum(axis=0) > 0)
    usual = [MEAN_OVER[0] <= kvp <= MEAN_OVER[1] for kvp in voltages]
    kev = moments[usual].sum(axis=0)[used] / counts[usual].sum(axis=0)[used]
    return kev.astype(np.float32), counts[:, used].astype(np.float32)


def main() -> None:
    output = Path(sys.argv[1]) if len(sys.argv) > 1 else OUTPUT
    about = (
        f"Unfiltered x-ray tube spectra made with SpekPy {spekpy.__version__}, model casim, "
        f"reflection target, anode angle {ANODE_ANGLE:g} degrees, "
        "photons per cm2 and mAs at 100 cm (bremsstrahlung: per keV)"
    )
    tables: dict[str, np.ndarray] = {"about": np.array(about)}
    for anode, voltages in TUBES.items():
        kev, counts = lines(anode, voltages)
        tables |= {
            f"{anode}_kvp": np.array(voltages, np.int16),
            f"{anode}_bremsstrahlung": bremsstrahlung(anode, voltages),
            f"{anode}_line_kev": kev,
            f"{anode}_line_counts": counts,
        }
    np.savez_compressed(output, **tables)  # type: ignore[arg-type]
    print(f"{output}: {output.stat().st_size / 1024:.0f} KB; {about}")


if __name__ == "__main__":
    main()

"""Every nuisance, in the order in which a report tells of them."""

from __future__ import annotations

from tomo_polysplat.nuisances.alignment import Alignment
from tomo_polysplat.nuisances.bowtie import Bowtie
from tomo_polysplat.nuisances.detector_blur import BlurOfDetector
from tomo_polysplat.nuisances.drift import Drift
from tomo_polysplat.nuisances.filters import Filters
from tomo_polysplat.nuisances.gains import Gains
from tomo_polysplat.nuisances.nuisance import Nuisance
from tomo_polysplat.nuisances.open_beam import OpenBeam
from tomo_polysplat.nuisances.pixel_light import PixelLight
from tomo_polysplat.nuisances.scatter import ScatteredLight
from tomo_polysplat.nuisances.spectral_factor import SpectralFactor
from tomo_polysplat.nuisances.tube_voltage import TubeVoltage

__all__ = ["NUISANCES", "SPECTRAL"]

NUISANCES: tuple[type[Nuisance], ...] = (
    Alignment,
    ScatteredLight,
    OpenBeam,
    TubeVoltage,
    Filters,
    Bowtie,
    BlurOfDetector,
    PixelLight,
    Gains,
    Drift,
)
# Those that a known density tells, by name.
SPECTRAL = {kind.name: kind for kind in NUISANCES if issubclass(kind, SpectralFactor)}

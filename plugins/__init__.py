"""Thin adapters to the programs people already use: TomoPy and ASTRA."""

from tomo_polysplat.plugins.astra_plugin import AstraOptions
from tomo_polysplat.plugins.hosts import register
from tomo_polysplat.plugins.tomopy_plugin import polysplat

__all__ = ["AstraOptions", "polysplat", "register"]

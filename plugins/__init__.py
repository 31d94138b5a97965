"""Thin adapters to the programs people already use: TomoPy and ASTRA."""

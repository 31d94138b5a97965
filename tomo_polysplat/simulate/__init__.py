"""Analytic phantoms scanned with exact chord lengths; shares no projection code with the solver."""

"""Folders as scanners write them, of a simulated scan: to try a reader, or a pipeline, without a scanner."""

"""Scans as scanners leave them: a folder of pictures and a text about them, each kind one file here."""

"""What was measured: geometries, volumes, scan files."""

"""Other ways to reconstruct the same scans, one algorithm a file, to compare with.

Each takes projections (views, rows, columns) with NaN where a ray was not measured, a geometry and a grid, and
returns a volume (nz, ny, nx) in 1/unit of length.
"""

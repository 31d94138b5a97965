"""Scans of ellipsoids in closed form, on any orbit."""

import numpy as np

from tomo_polysplat.scan.scan import Scan

# Attenuation, centre and radii.
BODY = (
    (0.25, (0, 0, 0), (1.6, 1.3, 1.2)),
    (0.5, (0.7, 0.35, 0), (0.32, 0.32, 0.7)),
    (-0.25, (-0.75, -0.3, 0.1), (0.35, 0.3, 0.5)),
    (2.5, (-0.35, 0.55, 0), (0.14, 0.14, 0.45)),
)


def orbit(angles, source=12.0, detector=8.0, pixel=0.16, height=0.0, down=0.0):
    """ASTRA's cone_vec rows: the source and the detector `height` up, the detector alone `down`."""
    s, c, zero = np.sin(angles), np.cos(angles), np.zeros_like(angles)
    vectors = np.zeros((len(angles), 12))
    vectors[:, :3] = np.stack([s * source, -c * source, zero + height], 1)
    vectors[:, 3:6] = np.stack([-s * detector, c * detector, zero + height - down], 1)
    vectors[:, 6:9] = np.stack([c, s, zero], 1) * pixel
    vectors[:, 11] = pixel
    return vectors


def chords(vectors, rows, columns, parts=BODY):
    """Line integrals (rows, views, columns) of a cone beam."""
    u, v = np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2
    step_u, step_v = vectors[:, None, None, 6:9], vectors[:, None, None, 9:12]
    pixel = vectors[:, None, None, 3:6] + u[:, None] * step_u + v[:, None, None] * step_v
    source = np.broadcast_to(vectors[:, None, None, :3], pixel.shape)
    ray = pixel - source
    ray = ray / np.linalg.norm(ray, axis=-1, keepdims=True)
    total = np.zeros(pixel.shape[:3])
    for attenuation, centre, radii in parts:
        d, o = ray / radii, (source - np.array(centre)) / radii
        a, b, c = (d * d).sum(-1), (d * o).sum(-1), (o * o).sum(-1) - 1
        total += attenuation * 2 * np.sqrt(np.maximum(b * b - a * c, 0)) / a
    return total.transpose(1, 0, 2)


def noisy(lines, photons=1e5, seed=0):
    """-log of Poisson counts."""
    counts = np.random.default_rng(seed).poisson(photons * np.exp(-lines))
    return -np.log(np.maximum(counts, 0.5) / photons).astype(np.float32)


def cone_scan(projections, vectors, half=2.0, low=None, high=None, slices=24):
    """A scan of these, in cm, its volume from -half to half and from low to high."""
    rows, _, columns = projections.shape
    low, high = (-half, half) if low is None else (low, high)
    window = {f"Window{end}{axis}": sign * half for end, sign in (("Min", -1), ("Max", 1)) for axis in "XY"}
    volume = {"GridRowCount": 24, "GridColCount": 24, "GridSliceCount": slices}
    volume["option"] = window | {"WindowMinZ": low, "WindowMaxZ": high}
    geometry = {"type": "cone_vec", "DetectorRowCount": rows, "DetectorColCount": columns, "Vectors": vectors}
    return Scan(projections, geometry, volume)


def whole_turn(views, turns=1):
    return np.linspace(0, 2 * np.pi * turns, views * turns, endpoint=False)

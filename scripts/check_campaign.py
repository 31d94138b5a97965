"""Count what `check` says of simulated scans: false alarms on clean ones, and planted defects at two strengths.

python scripts/check_campaign.py 60        # clean scans; writes Markdown to standard output
"""

from __future__ import annotations

import argparse
import logging
from collections import Counter
from dataclasses import replace

import numpy as np

from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.scan.check import check_scan
from tomo_polysplat.scan.geometry import from_astra, to_astra
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.scanner import Scanner
from tomo_polysplat.simulate.scenes import SCENES, scan_phantom, scene_phantom

KINDS = ("parallel", "fan", "cone", "half cone", "offset", "helical", "laminography", "tomosynthesis")
KINDS += ("short scan", "half acquisition", "few rows")
PHOTONS = (30, 300, 3e3, 3e4, 1e6)
# What is true of some geometries is no false alarm: the detector does not see all of the object.
TRUE = {
    "half cone": {"coverage"},
    "few rows": {"coverage"},
    "helical": {"coverage"},
    "laminography": {"truncation", "coverage"},
}


def geometry(kind: str, half: float, size: int, views: int) -> tuple[dict, dict]:
    """Projection and volume geometry of a scan of some kind, in cm."""
    parallel = kind in ("parallel", "half acquisition", "laminography")
    rows = 1 if kind == "fan" else 3 if kind == "few rows" else size
    columns, pixel = -(-3 * size // 2), 3.0 * half / (1.5 * size)
    arc = {"tomosynthesis": 60.0, "short scan": 210.0, "parallel": 180.0, "helical": 1080.0}.get(kind, 360.0)
    angles = np.deg2rad(arc) * np.arange(views) / views
    s, c, zero, one = np.sin(angles), np.cos(angles), np.zeros(views), np.ones(views)
    tilt = np.deg2rad(30) if kind == "laminography" else 0.0
    away = np.stack([s * np.cos(tilt), -c * np.cos(tilt), np.sin(tilt) * one], 1)
    across = np.stack([c, s, zero], 1)
    up = np.cross(away, across) * -1.0
    height = np.linspace(-half / 2, half / 2, views) if kind == "helical" else zero
    lift = np.stack([zero, zero, height], 1)
    side = {"offset": 0.3, "half acquisition": 0.35}.get(kind, 0.0) * columns * pixel
    if parallel:
        start, middle = -away, zero[:, None] * away
    else:
        pixel *= 1.5
        start, middle = 5 * half * away + lift, -2.5 * half * away + lift
        middle = middle - (0.4 * rows * pixel * np.array([0, 0, 1.0]) if kind == "half cone" else 0.0)
    vectors = np.hstack([start, middle + side * across, across * pixel, up * pixel])
    slices = 1 if kind == "fan" else size
    window = {f"Window{end}{axis}": sign * half for end, sign in (("Min", -1), ("Max", 1)) for axis in "XYZ"}
    if kind == "fan":
        window |= {"WindowMinZ": -half / size, "WindowMaxZ": half / size}
    volume = {"GridRowCount": size, "GridColCount": size, "GridSliceCount": slices, "option": window}
    told = {"type": "parallel3d_vec" if parallel else "cone_vec", "DetectorRowCount": rows}
    return told | {"DetectorColCount": columns, "Vectors": vectors}, volume


def simulated(number: int) -> tuple[str, Scan]:
    """The clean scan of that number: all kinds in turn, with scenes, sizes, views and light by chance."""
    rng = np.random.default_rng(number)
    kind = KINDS[number % len(KINDS)]
    scene, photons = str(rng.choice(list(SCENES))), float(PHOTONS[number // len(KINDS) % len(PHOTONS)])
    size, views = int(rng.integers(20, 41)), int(rng.integers(40, 121))
    where = geometry(kind, SCENES[scene].half_width, size, views)
    spectrum = Spectrum.from_tube(90, filters={"Al": 0.1}, detector="counting")
    scanner = Scanner(photons, 0.0 if photons < 1e3 else 3.0, 0.0, True, number)
    return kind, scan_phantom(
        scene_phantom(scene, bool(rng.random() < 0.5)), *where, spectrum, scanner, name=scene
    )


def planted(scan: Scan, seed: int) -> list[tuple[str, str, Scan, Scan]]:
    """Defect, its probe, and the scan with it, weak and strong."""
    rng, p = np.random.default_rng(seed), scan.projections

    def changed(values: np.ndarray) -> Scan:
        return replace(scan, projections=np.asarray(values, np.float32))

    def moved(columns: float) -> Scan:
        told = dict(scan.proj_geom)
        told["Vectors"] = told["Vectors"].copy()
        told["Vectors"][:, 3:6] += columns * told["Vectors"][:, 6:9]
        return replace(scan, proj_geom=told)

    def swapped(pairs: int) -> Scan:
        order = np.arange(scan.views)
        first = rng.choice(scan.views // 3, pairs, replace=False)
        order[first], order[first + scan.views // 2] = first + scan.views // 2, first
        return changed(p[:, order])

    def gap(columns: int) -> Scan:
        values = p.copy()
        values[..., scan.columns // 2 : scan.columns // 2 + columns] = 0
        return changed(values)

    def column(light: float) -> np.ndarray:
        """One near the axis that sees this share of the light."""
        values, here = p.copy(), near_axis
        values[..., here] -= np.log(light)
        return values

    def noise(deviation: float) -> np.ndarray:
        """One near the axis that shows nothing but noise, as deep as the object in the mean."""
        values, here = p.copy(), near_axis
        values[..., here] = rng.normal(np.median(p[..., here]), deviation, p.shape[:2])
        return values

    def longer(times: float) -> Scan:
        where, grid = from_astra(scan.proj_geom, scan.vol_geom)
        told, volume = to_astra(where.scaled(times), grid.scaled(times))
        return replace(scan, proj_geom=told, vol_geom=volume, truth=None, metal_mask=None)

    middle = from_astra(scan.proj_geom, scan.vol_geom)[0].project_points(np.zeros((1, 3)))[:, 0, 0]
    near_axis = int(np.clip(np.median(middle) + rng.integers(-3, 4), 1, scan.columns - 2))
    deep = np.percentile(p, 99)
    fall = np.linspace(0, 1, scan.views)[:, None]
    return [
        ("axis off by 1, 3 columns", "centre", moved(1.0), moved(3.0)),
        ("1, 8 pairs of views swapped", "order of views", swapped(1), swapped(8)),
        ("gap of 1, 6 columns of zeros", "bad rays", gap(1), gap(6)),
        ("column of 0.7, 0.5 of the light", "bad rays", changed(column(0.7)), changed(column(0.5))),
        ("column of noise of 0.3, 1", "bad rays", changed(noise(0.3 * deep)), changed(noise(deep))),
        ("flats 0.9, 0.5 of the light", "open beam", changed(p + np.log(0.9)), changed(p + np.log(0.5))),
        (
            "source falls by 5, 20 %",
            "open beam",
            changed(p - np.log(1 - 0.05 * fall)),
            changed(p - np.log(1 - 0.2 * fall)),
        ),
        ("transmissions, counts", "logarithm", changed(np.exp(-p)), changed(1e4 * np.exp(-p))),
        (
            "log to the base of 3, of 10",
            "base of the logarithm",
            changed(p / np.log(3)),
            changed(p / np.log(10)),
        ),
        ("lengths 100, 10 000 times too long", "unit of length", longer(1e2), longer(1e4)),
    ]


def unseen(number: int) -> int:
    """The first number from this one on where all kinds follow with 3000 photons."""
    turn = len(KINDS) * len(PHOTONS)
    return number + (len(KINDS) * PHOTONS.index(3e3) - number) % turn


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("scans", type=int, nargs="?", default=55)
    parser.add_argument("--planted", type=int, default=11, help="scans, after the clean ones, for defects")
    parser.add_argument("--from", type=int, default=0, dest="first", help="number of the first clean scan")
    arguments = parser.parse_args()
    logging.disable(logging.CRITICAL)
    answers: dict[str, Counter] = {}
    alarms = []
    for number in range(arguments.first, arguments.first + arguments.scans):
        kind, scan = simulated(number)
        for finding in check_scan(scan):
            verdict = str(finding.verdict)
            if verdict == "defect" and finding.probe in TRUE.get(kind, ()):
                verdict = "defect that is there"
            if verdict == "defect":
                alarms.append(
                    f"{number} {kind} {scan.name} {scan.notes['photons']:g}: {finding.probe}: {finding.text}"
                )
            answers.setdefault(finding.probe, Counter())[verdict] += 1
    columns = ("ok", "unknown", "defect", "defect that is there")
    print(f"| {arguments.scans} clean scans | {' | '.join(columns)} |\n|---|{'---|' * len(columns)}")
    for probe, counts in answers.items():
        print(f"| {probe} | {' | '.join(str(counts[name]) for name in columns)} |")
    print("", *alarms, sep="\n")
    found: dict[str, tuple[Counter, Counter]] = {}
    first = unseen(arguments.first + arguments.scans)
    for number in range(first, first + arguments.planted):
        for name, probe, *strengths in planted(simulated(number)[1], number):
            both = found.setdefault(name, (Counter(), Counter()))
            for counts, scan in zip(both, strengths):
                counts.update(str(f.verdict) for f in check_scan(scan) if f.probe == probe)
    print("\n| Planted | weak: found, unknown, ok | strong: found, unknown, ok |\n|---|---|---|")
    for name, both in found.items():
        print(
            f"| {name} | "
            + " | ".join(", ".join(str(c[v]) for v in ("defect", "unknown", "ok")) for c in both)
            + " |"
        )


if __name__ == "__main__":
    main()

"""Tell how much of their contrast the faint inclusions of a simulated scene keep, and what that costs in noise.

python scripts/faint.py teeth 64 180
python scripts/faint.py pins 64 180 --without

Of each reconstruction it prints PSNR without metal and everywhere (dB), the share of the true contrast that inclusions
of 27 voxels and more keep, that of smaller ones, and the deviation of the main matter 3 voxels and more from anything
over its attenuation; then the same of FDK (Ram-Lak, after a water correction). ``--without`` smooths faint differences
as all others. ``--ideal`` scans without metal and noise, with one energy and with the spectrum: what any method of one
curve can see.
"""

from __future__ import annotations

import argparse

import numpy as np
from scipy import ndimage

from tomo_polysplat.fit import loss
from tomo_polysplat.kernels.step import faint
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.physics.water import water_linearised
from tomo_polysplat.reconstruction import reconstruct
from tomo_polysplat.result.metrics import compare
from tomo_polysplat.scan.geometry import from_astra, projections_from_astra
from tomo_polysplat.scan.scan import Scan
from tomo_polysplat.simulate.phantom import Phantom
from tomo_polysplat.simulate.scenes import SCENES, scene_phantom, simulate_scan
from tomo_polysplat.start.fdk import fdk

# Contrasts that count as faint, and voxels of an inclusion.
_FAINT, _VOXELS = (0.025, 0.18), (8, 300)
_CUBE = np.ones((3, 3, 3), bool)


def labels_of(phantom: Phantom, size: int, half_width: float) -> np.ndarray:
    """(size, size, size) number of the matter at voxel centres, by material and density, fat by material alone."""
    ends = (np.arange(size) + 0.5) / size * 2 * half_width - half_width
    z, y, x = np.meshgrid(ends, ends, ends, indexing="ij")
    points, labels = np.stack([x, y, z], axis=-1), np.zeros((size,) * 3, int)
    known: dict[tuple[str, float], int] = {}
    for part in phantom.parts:
        density = part.density if part.material != "adipose" else 0.2 * int(5 * part.density)
        number = known.setdefault((part.material, density), len(known) + 1) if density else 0
        labels[part.shape.contains(points)] = number
    return labels


def inclusions(scan: Scan, labels: np.ndarray) -> list[tuple[np.ndarray, np.ndarray]]:
    """Masks of the faint inclusions away from metal, air and what is much denser, and of the matter around each."""
    assert scan.truth is not None and scan.metal_mask is not None
    found = []
    for number in np.unique(labels[labels > 0]):
        pieces, count = ndimage.label(labels == number)
        for mask in (pieces == k for k in range(1, count + 1)):
            if not _VOXELS[0] <= mask.sum() <= _VOXELS[1]:
                continue
            beside = ndimage.binary_dilation(mask, _CUBE)
            near = ndimage.binary_dilation(beside, _CUBE, iterations=2)
            relative = scan.truth[near] / scan.truth[mask].mean()
            if scan.metal_mask[near].any() or relative.min() < 0.5 or relative.max() > 1.6:
                continue
            matter = np.bincount(labels[near & ~mask]).argmax()
            ring = near & ~beside & ~ndimage.binary_dilation(labels != matter, _CUBE)
            if ring.sum() >= 30 and _FAINT[0] <= abs(_contrast(scan.truth, mask, ring)) <= _FAINT[1]:
                found.append((mask, ring))
    return found


def figures(volume: np.ndarray, scan: Scan, labels: np.ndarray) -> str:
    """PSNR, kept contrast and noise of a volume, as a line."""
    assert scan.truth is not None
    errors = compare(volume, scan.truth, scan.metal_mask)
    line = f"{errors['psnr']:.2f} / {errors['psnr_all']:.2f} dB"
    pairs = inclusions(scan, labels)
    for words, large in (("27 voxels and more", True), ("smaller", False)):
        some = [pair for pair in pairs if (pair[0].sum() >= 27) == large]
        true, got, voxels = (
            np.array([function(*pair) for pair in some])
            for function in (
                lambda mask, ring: _contrast(scan.truth, mask, ring),
                lambda mask, ring: _contrast(volume, mask, ring),
                lambda mask, ring: mask.sum(),
            )
        )
        kept = (voxels * true * got).sum() / (voxels * true**2).sum() if some else np.nan
        line += f", {words} ({len(some)}) keep {kept:.2f}"
    return f"{line}, noise {_noise(volume, scan, labels):.4f}"


def _contrast(volume: np.ndarray, mask: np.ndarray, ring: np.ndarray) -> float:
    return float(volume[mask].mean() / volume[ring].mean() - 1)


def _noise(volume: np.ndarray, scan: Scan, labels: np.ndarray) -> float:
    edge = ndimage.maximum_filter(labels, 3) != ndimage.minimum_filter(labels, 3)
    far = (ndimage.distance_transform_edt(~(edge | scan.metal_mask)) >= 3) & (labels > 0)
    main = volume[far & (labels == np.bincount(labels[far]).argmax())]
    return float(main.std() / main.mean())


def _fdk(scan: Scan) -> np.ndarray:
    geometry, grid = from_astra(scan.proj_geom, scan.vol_geom)
    values = projections_from_astra(scan.projections, scan.proj_geom)
    assert scan.spectrum is not None
    corrected = water_linearised(values, scan.spectrum).astype(np.float32)
    return fdk(corrected, geometry, grid, filter_name="ram-lak")


def main() -> None:
    """Scan, reconstruct and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", choices=list(SCENES))
    parser.add_argument("size", type=int)
    parser.add_argument("views", type=int)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="auto")
    parser.add_argument("--without", action="store_true")
    parser.add_argument("--ideal", action="store_true")
    given = parser.parse_args()
    phantom = scene_phantom(given.scene, not given.ideal)
    labels = labels_of(phantom, given.size, SCENES[given.scene].half_width)
    options = {"metal": not given.ideal, "noise": not given.ideal, "seed": given.seed}
    scan = simulate_scan(given.scene, given.size, given.views, **options)
    assert scan.spectrum is not None
    if given.ideal:
        one = Spectrum(np.array([scan.spectrum.effective_energy]), np.array([1.0]))
        alone = simulate_scan(given.scene, given.size, given.views, spectrum=one, **options)
        print("FDK, one energy:", figures(_fdk(alone), alone, labels))
    else:
        if given.without:
            # Nothing is away from edges.
            loss.EDGE = faint.EDGE = 0.0
        result = reconstruct(
            scan.projections,
            scan.proj_geom,
            scan.vol_geom,
            spectrum=scan.spectrum,
            unit=scan.unit,
            seed=given.seed,
            device=given.device,
        )
        print(f"{result.seconds:.1f} s:", figures(result.volume, scan, labels))
    print("FDK:", figures(_fdk(scan), scan, labels))


if __name__ == "__main__":
    main()

"""``tomo-polysplat simulate``: a scan of a known object."""

from __future__ import annotations

import argparse
from pathlib import Path

from tomo_polysplat.checks import visible
from tomo_polysplat.cli.options import add_spectrum_options, spectrum_from
from tomo_polysplat.files import require_replaceable, require_room, require_writable

NAME = "simulate"
HELP = "simulate a polychromatic scan of a known object, with its truth"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Options of this subcommand."""
    parser.add_argument("scene", help="pins, teeth, lung, broccoli, pancreas or pepper")
    parser.add_argument("-o", "--output", required=True, metavar="FILE", help=".h5 (Data Exchange) or .npz")
    parser.add_argument("--overwrite", action="store_true", help="replace a file that exists")
    parser.add_argument("--size", type=int, default=64, help="voxels per edge of the volume (default: 64)")
    parser.add_argument("--views", type=int, default=180, help="projection images (default: 180)")
    parser.add_argument(
        "--geometry", choices=["cone", "parallel", "fan"], default="cone", help="default: cone"
    )
    parser.add_argument(
        "--metal", help="metal instead of the scene's own, such as titanium; none leaves it out"
    )
    parser.add_argument(
        "--photons", type=float, default=1e5, help="photons per open-beam pixel (default: 1e5)"
    )
    parser.add_argument(
        "--scatter", type=float, default=0.0, help="scatter, as a share of the open beam (default: 0)"
    )
    parser.add_argument("--no-noise", action="store_true", help="leave out the noise")
    parser.add_argument("--seed", type=int, default=0, help="seed of the noise (default: 0)")
    add_spectrum_options(parser)


def run(arguments: argparse.Namespace) -> int:
    """Simulate and write."""
    from tomo_polysplat.scan.io import require_scan_name, save_scan
    from tomo_polysplat.simulate.scenes import scan_bytes, simulate_scan

    output = Path(arguments.output)
    require_scan_name(output, "--output")
    require_replaceable(output, arguments.overwrite, "pass --overwrite", "--output")
    require_writable(output.parent, "--output")
    require_room(output.parent, scan_bytes(arguments.size, arguments.views, arguments.geometry))
    scan = simulate_scan(
        arguments.scene,
        arguments.size,
        arguments.views,
        metal={None: True, "none": False}.get(arguments.metal, arguments.metal),
        spectrum=spectrum_from(arguments),
        photons=arguments.photons,
        scatter=arguments.scatter,
        seed=arguments.seed,
        noise=not arguments.no_noise,
        geometry=arguments.geometry,
    )
    save_scan(scan, output, overwrite=arguments.overwrite)
    print(visible(scan))
    print(f"wrote {visible(output)}")
    return 0

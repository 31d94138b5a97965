"""Scanners that are not read: the refusal has all that their text tells, as options that do."""

import re
import shlex

import numpy as np
import pytest
from folders import marked, require_the_same_volume

import tomo_polysplat as tps
from tomo_polysplat.cli.main import main
from tomo_polysplat.simulate.folders.write import write_folder

# As each maker's program writes the keys, with the numbers of the simulated scan.
TEXTS = {
    "GE phoenix": (
        "scan.pca",
        "[General]\nVersion=2.8\n[Geometry]\nFDD=250.00000000\nFOD=100.00000000\nVoxelSizeX=0.64000000\n"
        "CalibValue=-1.5\n[CT]\nRotationSector=360.00000000\n[Image]\nFreeRay=30000\n[CalibImages]\n"
        "MGainVoltage=60:60:60:\n[Xray]\nVoltage=90\nFilter=0.2Cu\n",
    ),
    "Diondo": (
        "scan.xml",
        "<Scan><Geometrie><SourceDetectorDist>250.0</SourceDetectorDist><SourceObjectDist>100.0</SourceObjectDist>"
        "</Geometrie><Recon><ProjectionPixelSizeX>1.6</ProjectionPixelSizeX></Recon></Scan>",
    ),
    "Yxlon": (
        "ScanParameter.xml",
        "<ScanParameter><ConeBeamScanParameter><ScanTrajectory><PixelPitch>1,6</PixelPitch><Fdd>156,25</Fdd>"
        "<Fod>62,5</Fod><Rotation>360</Rotation></ScanTrajectory></ConeBeamScanParameter></ScanParameter>",
    ),
    "RX Solutions": (
        "unireconstruction.xml",
        '<unireconstruction><conebeam><acquisitioninfo><geometry sdd="250" sod="100"/><xray voltage="90" '
        'current="100"/></acquisitioninfo></conebeam></unireconstruction>',
    ),
}


@pytest.fixture
def folder(tmp_path):
    """Pictures with flats and darks, and nothing that tells the distances."""
    write_folder("tiffs", tmp_path / "sample", marked())
    for file in (tmp_path / "sample").glob("*.toml"):
        file.unlink()
    return tmp_path / "sample"


def refusal(path):
    with pytest.raises(ValueError) as told:
        tps.load_scan(path)
    return str(told.value)


@pytest.mark.parametrize("maker", TEXTS)
def test_the_refusal_tells_what_the_text_tells(folder, maker):
    name, text = TEXTS[maker]
    (folder / name).write_text(text.replace("\n", "\r\n"), encoding="cp1252", newline="")
    message = refusal(folder)
    assert f"{name} of {maker}, which is not read" in message and len(message) < 400
    pixel = "..." if maker == "RX Solutions" else "1.6"
    assert f"--sod 100 --sdd 250 --pixel {pixel} --angles 360" in message
    assert ("--kvp 90" in message) == (maker in ("GE phoenix", "RX Solutions"))


def test_the_options_of_the_refusal_make_the_scan(folder):
    """Copied from the message to the command line: the marker is where it is."""
    name, text = TEXTS["GE phoenix"]
    (folder / name).write_text(text)
    options = re.search(r"pass (--.*?) \(or", refusal(folder))
    assert options is not None
    output = folder.parent / "scan.h5"
    command = ["import", str(folder), "-o", str(output)]
    # Where the axis is stands in no text that is published.
    assert main([*command, *shlex.split(options[1]), "--offset", "2.4", "0"]) == 0
    scan = tps.load_scan(output)
    require_the_same_volume(scan, marked())
    assert np.isfinite(scan.projections).all()


def test_what_is_stated_stands_over_the_text(folder):
    (folder / "scan.pca").write_text(TEXTS["GE phoenix"][1])
    stated = {"sod": 100.0, "sdd": 250.0, "pixel": 1.6, "offset": (2.4, 0.0), "arc": 360.0}
    require_the_same_volume(tps.load_scan(folder, scanner=stated), marked())


def test_raw_pictures_are_to_become_tiffs(tmp_path):
    (tmp_path / "scan.xml").write_text(TEXTS["Diondo"][1])
    (tmp_path / "Projection").mkdir()
    (tmp_path / "Projection" / "_0012,50_0000.raw").write_bytes(bytes(100))
    for path in (tmp_path, tmp_path / "scan.xml"):
        assert "import the folder of its TIFFs with --sod 100" in refusal(path)


def test_texts_that_are_no_scanner_are_passed_over(folder):
    (folder / "notes.xml").write_text("<notes>nothing</notes>")
    (folder / "other.pca").write_bytes(b"\0\1\2")
    assert "--sod, --sdd, --pixel" in refusal(folder)

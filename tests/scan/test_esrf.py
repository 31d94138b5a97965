"""A scan of the ESRF in EDF: which pictures are which, and what the .info text tells."""

import numpy as np
import pytest

import tomo_polysplat as tps
from tomo_polysplat.simulate.folders.write import write_folder


@pytest.fixture
def folder(tmp_path):
    write_folder("esrf", tmp_path / "marker")
    return tmp_path / "marker"


def change(folder, old, new):
    text = (folder / "marker.info").read_text()
    assert old in text
    (folder / "marker.info").write_text(text.replace(old, new))


def guesses(scan):
    return " | ".join(scan.notes["scanner"]["guessed"])


def test_pictures_of_the_way_back_and_references_are_no_views(folder):
    scan = tps.load_scan(folder)
    assert len(list(folder.glob("marker*.edf"))) == 50 and scan.views == 48
    told = scan.notes["scanner"]
    assert told["kind"] == "ESRF (.info, EDF)" and told["exposure_s"] == "0.1"
    assert told["keys"]["/Energy"] == "60.0" and "no dark" not in guesses(scan)
    assert "the beam is taken to be parallel" in guesses(scan)


def test_names_with_a_line_between_and_pictures_that_are_missing(folder):
    even = tps.load_scan(folder)
    for file in folder.glob("marker0*.edf"):
        file.rename(folder / file.name.replace("marker", "marker_"))
    (folder / "marker_0007.edf").unlink()
    scan = tps.load_scan(folder)
    assert scan.views == 47 and "jump (6 to 8)" in guesses(scan) and "47 pictures are there" in guesses(scan)
    np.testing.assert_array_equal(scan.projections[:, 7:], even.projections[:, 8:])
    left = np.delete(np.arange(48), 7)
    np.testing.assert_allclose(scan.proj_geom["Vectors"], even.proj_geom["Vectors"][left], atol=1e-9)


def test_without_medians_the_single_references_are_taken(folder):
    expected = tps.load_scan(folder)
    for file in folder.glob("refHST*.edf"):
        file.unlink()
    np.testing.assert_allclose(tps.load_scan(folder).projections, expected.projections, atol=1e-6)
    (folder / "dark.edf").unlink()
    assert "no dark pictures" in guesses(tps.load_scan(folder))


def test_a_text_that_cannot_be_meant(folder):
    change(folder, "PixelSize=              640", "")
    scan = tps.load_scan(folder)
    assert scan.unit == "pixel" and "the pixel is not known" in guesses(scan)
    change(folder, "TOMO_N=                 48", "TOMO_N=                 0")
    with pytest.raises(ValueError, match="TOMO_N: expected a finite number >= 1"):
        tps.load_scan(folder)
    (folder / "marker_0001.edf").write_bytes((folder / "marker0001.edf").read_bytes())
    change(folder, "TOMO_N=                 0", "TOMO_N=                 9")
    with pytest.raises(
        ValueError, match="EDF pictures of one name, numbered one after the other, got marker"
    ):
        tps.load_scan(folder)
    for file in folder.glob("marker*.edf"):
        file.unlink()
    change(folder, "TOMO_N=                 9", "TOMO_N=                 4")
    with pytest.raises(ValueError, match="EDF pictures named marker0000.edf and so on, got none"):
        tps.load_scan(folder)


def test_the_dark_picture_of_the_end_is_a_sum(folder):
    expected = tps.load_scan(folder)
    dark = (folder / "dark.edf").read_bytes()
    end = dark.index(b"}") + 2
    summed = 20 * np.frombuffer(dark[end:], "<f4")
    (folder / "dark.edf").unlink()
    (folder / "darkend0000.edf").write_bytes(dark[:end] + summed.astype("<f4").tobytes())
    change(folder, "TOMO_N=", "DARK_N=                 20\nTOMO_N=")
    np.testing.assert_allclose(tps.load_scan(folder).projections, expected.projections, atol=1e-6)


def test_what_is_stated_is_no_guess(folder):
    (folder / "scan.toml").write_text("offset = [0.0, 0.0]\n")
    assert "the axis is taken" not in guesses(tps.load_scan(folder))
    (folder / "scan.toml").unlink()
    assert "the axis is taken" in guesses(tps.load_scan(folder))
    cone = {"source_object": 900.0, "source_detector": 1000.0}
    assert "parallel" not in guesses(tps.load_scan(folder, scanner=cone))

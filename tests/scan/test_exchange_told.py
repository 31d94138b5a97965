"""Data Exchange without geometry, of a cone beam that the user describes."""

import h5py
import numpy as np
import pytest
from folders import marked, require_the_same_volume

import tomo_polysplat as tps
from tomo_polysplat.cli.main import main
from tomo_polysplat.simulate.folders.scene import SETTINGS, pictures_of

SCANNER = {
    "source_object": SETTINGS.source_object,
    "source_detector": SETTINGS.source_detector,
    "pixel": SETTINGS.pixel,
    "offset": (SETTINGS.pixel * SETTINGS.columns_off, 0.0),
}


@pytest.fixture
def path(tmp_path):
    """Counts, top row first, as a camera writes them."""
    pictures = pictures_of(marked())
    with h5py.File(tmp_path / "scan.h5", "w") as file:
        for name, value in (
            ("data", pictures.projections),
            ("data_white", pictures.flats),
            ("data_dark", pictures.darks),
            ("theta", pictures.degrees),
        ):
            file[f"exchange/{name}"] = value
    return tmp_path / "scan.h5"


def test_a_cone_beam_that_is_described(path):
    scan = tps.load_scan(path, scanner=SCANNER)
    assert scan.unit == "mm" and scan.proj_geom["type"] == "cone_vec" and scan.name == "scan"
    require_the_same_volume(scan, marked())
    part = tps.load_scan(path, scanner=SCANNER, rows=(4, 20), columns=(3, 33), views=3)
    np.testing.assert_array_equal(part.projections, scan.projections[33 - 20 : 33 - 4, ::3, 3:33])
    # Which row and which side are first can be told as of pictures.
    with h5py.File(path, "r+") as file:
        for name in ("data", "data_white", "data_dark"):
            file[f"exchange/{name}"][...] = file[f"exchange/{name}"][()][:, ::-1, ::-1]
    turned = tps.load_scan(path, scanner=SCANNER | {"first_row": "bottom", "seen_from": "detector"})
    np.testing.assert_array_equal(turned.projections, scan.projections)


def test_angles_flats_and_a_spectrum_that_the_file_lacks(path):
    expected = tps.load_scan(path, scanner=SCANNER)
    with h5py.File(path, "r+") as file:
        white, dark = file["exchange/data_white"][0], file["exchange/data_dark"][0]
        for name in ("theta", "data_white", "data_dark"):
            del file[f"exchange/{name}"]
        file["exchange/data_dark"] = dark  # one picture without an axis for their number
    np.save(path.parent / "flat.npy", white)
    scan = tps.load_scan(
        path, scanner=SCANNER | {"arc": 360, "flats": "flat.npy", "kvp": 90, "filter": "Al 1mm"}
    )
    np.testing.assert_array_equal(scan.projections, expected.projections)
    np.testing.assert_allclose(scan.proj_geom["Vectors"], expected.proj_geom["Vectors"], atol=1e-9)
    assert expected.spectrum is None
    assert scan.spectrum.effective_energy == pytest.approx(marked().spectrum.effective_energy)


def test_radians_are_those_of_the_file_s_own_word(path):
    expected = tps.load_scan(path, scanner=SCANNER)
    with h5py.File(path, "r+") as file:
        file["exchange/theta"][...] = np.deg2rad(file["exchange/theta"][()])
        file["exchange/theta"].attrs["units"] = "radians"
    scan = tps.load_scan(path, scanner=SCANNER)
    np.testing.assert_allclose(scan.proj_geom["Vectors"], expected.proj_geom["Vectors"], atol=1e-9)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"pixel": None}, "the distances and the pixel of the scanner"),
        ({"source_object": None}, "source_object, source_detector: expected both distances of a cone beam"),
        ({"degrees": [0, 90]}, "one angle for each of 48 pictures, got 2"),
        ({"pixle": 1}, "did you mean pixel"),
    ],
)
def test_what_is_missing_is_named(path, changed, message):
    with pytest.raises(ValueError, match=message):
        tps.load_scan(path, scanner=SCANNER | changed)


def test_a_file_with_a_geometry_is_not_described_again(path):
    scan = tps.load_scan(path, scanner=SCANNER)
    tps.save_scan(scan, path.parent / "own.h5")
    with pytest.raises(ValueError, match="scanner: expected nothing for a scan that has its own geometry"):
        tps.load_scan(path.parent / "own.h5", scanner=SCANNER)


def test_the_command_line_has_the_same_words(path, monkeypatch):
    at = SETTINGS
    monkeypatch.chdir(path.parent)
    command = ["import", path.name, "-o", "cone.h5"]
    command += ["--sod", str(at.source_object), "--sdd", str(at.source_detector), "--pixel", str(at.pixel)]
    assert main([*command, "--offset", str(at.pixel * at.columns_off), "0"]) == 0
    scan, told = tps.load_scan(path.parent / "cone.h5"), tps.load_scan(path, scanner=SCANNER)
    np.testing.assert_array_equal(scan.projections, told.projections)
    np.testing.assert_equal(scan.proj_geom, told.proj_geom)
    assert scan.unit == "mm"


def test_the_first_row_of_a_parallel_beam_is_the_first_slice_whatever_else_is_told(path):
    plain = tps.load_scan(path, centre=20.0, pixel_size=0.4, unit="mm")
    told = tps.load_scan(
        path, scanner={"beam": "parallel", "pixel": 0.4, "offset": (0.0, 0.0), "name": "tooth"}
    )
    np.testing.assert_allclose(told.projections, plain.projections, atol=1e-6)
    assert told.name == "tooth"
    turned = tps.load_scan(
        path, scanner={"beam": "parallel", "pixel": 0.4, "name": "tooth", "first_row": "top"}
    )
    np.testing.assert_array_equal(turned.projections, told.projections[::-1])


@pytest.mark.parametrize("scanner", [None, SCANNER])
def test_references_of_before_and_after(path, scanner):
    known = {} if scanner is None else {"scanner": scanner}
    expected = tps.load_scan(path, **known)
    with h5py.File(path, "r+") as file:
        exchange = file["exchange"]
        white = exchange["data_white"][()]
        assert len(white) > 1
        exchange["data_white_pre"], exchange["data_white_post"] = white[:1], white[1:]
        exchange["data_dark_post"] = exchange["data_dark"][()]
        for name in ("data_white", "data_dark"):
            del exchange[name]
        exchange["data_dark"] = np.zeros((0, *white.shape[1:]), white.dtype)
    np.testing.assert_allclose(tps.load_scan(path, **known).projections, expected.projections, atol=1e-6)

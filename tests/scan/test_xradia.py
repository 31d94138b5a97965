"""A .txrm file of Zeiss': drift, exposures, references, what is left open, and damage."""

import numpy as np
import olefile
import pytest
from folders import marked, require_the_same_volume

import tomo_polysplat as tps
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.readers.compound import CompoundFile
from tomo_polysplat.scan.readers.xradia_frames import picture_names
from tomo_polysplat.simulate.folders.compound_file import compound_file
from tomo_polysplat.simulate.folders.scene import pictures_of
from tomo_polysplat.simulate.folders.xradia import single_views, streams_of


@pytest.fixture(scope="module")
def streams():
    return streams_of(pictures_of(marked()))


@pytest.fixture
def write(tmp_path, streams):
    """Write the file; arguments replace or (None) remove streams."""

    def written(changes=None, name="marker.txrm"):
        content = {key: value for key, value in (streams | (changes or {})).items() if value is not None}
        (tmp_path / name).write_bytes(compound_file(content))
        return tmp_path / name

    return written


def floats(*values):
    return np.array(values, "<f4").tobytes()


def guesses(scan):
    return " | ".join(scan.notes["scanner"]["guessed"])


def test_an_independent_reader_finds_no_defect_in_the_file_that_is_written(write, streams):
    with olefile.OleFileIO(str(write()), raise_defects=olefile.DEFECT_UNSURE) as file:
        assert not file.parsing_issues
        assert sorted("/".join(entry) for entry in file.listdir()) == sorted(streams)
        for name, content in streams.items():
            assert file.openstream(name).read() == content, name


def test_the_shifts_bring_the_axis_of_each_picture_to_its_place(write):
    """A picture that has to go two columns to the right shows everything two columns too far left."""
    scan = tps.load_scan(write())
    geometry, _ = from_astra(scan.proj_geom, scan.vol_geom)
    found = geometry.project_points(np.zeros((1, 3)))
    column, row = found[:, 0, 0], found[:, 0, 1]
    moved = np.arange(48) % 3 == 1
    np.testing.assert_allclose(column, 18 - 1.5 - 2 * moved, atol=1e-4)
    np.testing.assert_allclose(row, 16 + 1 * moved, atol=1e-4)


def test_pictures_that_begin_at_the_top_and_are_seen_from_behind(write):
    """What is stated turns the shifts as well as the pictures."""
    pictures = pictures_of(marked())
    for name in ("projections", "flats", "darks"):
        object.__setattr__(pictures, name, getattr(pictures, name)[:, ::-1, ::-1])
    shifts = [np.frombuffer(streams_of(pictures)[f"Alignment/{axis}-Shifts"], "<f4") for axis in "XY"]
    assert all(side.any() for side in shifts)
    path = write(streams_of(pictures))
    stated = {"first_row": "top", "seen_from": "detector", "offset": (2.4, 0.0)}
    require_the_same_volume(tps.load_scan(path, scanner=stated), marked())


def test_exposures_that_differ_from_that_of_the_open_beam(write):
    exact = tps.load_scan(write())
    scan = tps.load_scan(write({"ReferenceData/ExpTime": floats(0.25)}))
    np.testing.assert_allclose(scan.projections, exact.projections + np.log(2), atol=1e-5)
    assert "pictures of 0.5 s are compared with an open beam of 0.25 s" in guesses(scan)


def test_several_references_and_those_of_another_file(write, streams):
    exact = tps.load_scan(write())
    flat = np.frombuffer(streams["ReferenceData/Image"], "<f4")
    several = {
        "ReferenceData/Image": None,
        "MultiReferenceData/TotalRefImages": np.array(2, "<i4").tobytes(),
        "MultiReferenceData/DataType": streams["ReferenceData/DataType"],
        "MultiReferenceData/Image1": floats(*(0.5 * flat)),
        "MultiReferenceData/Image2": floats(*(1.5 * flat)),
    }
    np.testing.assert_allclose(tps.load_scan(write(several)).projections, exact.projections, atol=1e-5)
    without = write({"ReferenceData/Image": None})
    assert "no flat field" in guesses(tps.load_scan(without))
    one = {
        "ImageInfo/NoOfImages": np.array(1, "<i4").tobytes(),
        "ImageData1/Image1": streams["ReferenceData/Image"],
    }
    one |= {"ImageInfo/DataType": streams["ReferenceData/DataType"]}
    write(one, "open.xrm")
    given = tps.load_scan(without.parent, scanner={"flats": "open.xrm"})
    np.testing.assert_array_equal(given.projections, exact.projections)


def test_references_that_only_their_names_and_bytes_tell_of(write, streams):
    """Neither their number nor their type is told in every file; their exposure stands in several places."""
    exact = tps.load_scan(write())
    flat = np.frombuffer(streams["ReferenceData/Image"], "<f4")
    bare = {name: None for name in streams if name.startswith("ReferenceData")}
    several = {
        f"MultiReferenceData/Image{k + 1}": floats(*(part * flat)) for k, part in enumerate((0.5, 1.5))
    }
    halved = {"MultiReferenceData/ImageInfo/ExpTimes": floats(0.25, 0.25)}
    scan = tps.load_scan(write(bare | several | halved))
    np.testing.assert_allclose(scan.projections, exact.projections + np.log(2), atol=1e-5)
    smaller = {
        "ReferenceData/ImageInfo/ImageWidth": b"\x05\0\0\0",
        "ReferenceData/ImageInfo/ImageHeight": b"\x05\0\0\0",
    }
    assert "no flat field" in guesses(tps.load_scan(write(smaller)))


def test_what_else_real_files_may_lack_or_say_otherwise(write):
    exact = tps.load_scan(write())
    missing = dict.fromkeys(
        ("ImageInfo/NoOfImages", "ImageInfo/ImagesTaken", "ImageInfo/DataType", "ImageInfo/ExpTimes")
    )
    microns = {
        "PositionInfo/AxisNames": b"Sample X\0Source Z\0",
        "PositionInfo/AxisUnits": b"um\0um\0",
        "ImageInfo/StoRADistance": floats(-1e5),
        "ImageInfo/DtoRADistance": floats(1.5e5),
        "ImageInfo/ExpTime": floats(0.5),
        "AutoRecon/CenterShift": floats(2.5),
    }
    scan = tps.load_scan(write(missing | microns))
    np.testing.assert_allclose(scan.proj_geom["Vectors"], exact.proj_geom["Vectors"], rtol=1e-6, atol=1e-9)
    np.testing.assert_array_equal(scan.projections, exact.projections)
    assert "1.5 columns off, as ReconSettings tells; AutoRecon tells 2.5" in guesses(scan)


def test_a_zone_plate_makes_a_parallel_beam(write):
    changes = {"ImageInfo/XrayGeometry": None, "ConfigZonePlates/ZonePlate0/Name": b"LFOV\0"}
    scan = tps.load_scan(write(changes), views=4)
    assert from_astra(scan.proj_geom, scan.vol_geom)[0].beam == "parallel"


def test_pictures_lie_in_folders_of_a_hundred(tmp_path):
    names = [f"ImageData{1 + k // 100}/Image{k + 1}" for k in range(202)]
    (tmp_path / "many.txrm").write_bytes(compound_file(dict.fromkeys(names, b"12")))
    assert picture_names(CompoundFile(tmp_path / "many.txrm")) == names


def test_a_scan_that_was_broken_off_and_what_is_not_known(write):
    changes = {
        "ImageInfo/ImagesTaken": np.array(40, "<i4").tobytes(),
        "ImageData1/Image38": None,
        "ReconSettings/CenterShift": None,
        "AcquisitionSettings/SourceFilterName": b"LE3\0",
    }
    scan = tps.load_scan(write(changes))
    assert scan.views == 37 and scan.spectrum is None
    for words in (
        "37 pictures are there, the file tells of 48",
        "the axis is taken",
        "its filter is not known",
    ):
        assert words in guesses(scan)
    assert scan.notes["scanner"]["keys"]["SourceFilterName"] == "LE3"


def test_a_parallel_beam_has_the_pixel_of_the_object(write):
    scan = tps.load_scan(write({"ImageInfo/XrayGeometry": np.array(2, "<i4").tobytes()}), views=4)
    geometry, _ = from_astra(scan.proj_geom, scan.vol_geom)
    assert geometry.beam == "parallel"
    np.testing.assert_allclose(np.linalg.norm(geometry.u, axis=1), 0.64, rtol=1e-6)


def test_only_what_is_wanted_is_read(write, monkeypatch):
    read, stream = [], CompoundFile.stream

    def noted(self, name, **known):
        read.append(name)
        return stream(self, name, **known)

    monkeypatch.setattr(CompoundFile, "stream", noted)
    scan = tps.load_scan(write(), views=(3, 48, 20), rows=(2, 9), binning=2)
    assert scan.projections.shape == (3, 3, 18)
    assert [name for name in read if name.startswith("ImageData")] == [
        f"ImageData1/Image{k}" for k in (4, 24, 44)
    ]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ImageInfo/Angles": floats(0, 1)}, "one finite number for each of 48 pictures, got 2"),
        ({"ImageInfo/StoRADistance": None}, "distances as ImageInfo/StoRADistance"),
        ({"ImageInfo/PixelSize": floats(np.nan)}, "the size of a pixel as ImageInfo/PixelSize"),
        ({"ImageInfo/DataType": np.array(12, "<i4").tobytes()}, "of type 12.0"),
        (
            {"ImageInfo/ImageWidth": np.array(3, "<i4").tobytes()},
            "Image: expected at most 396 bytes, got 4884",
        ),
        ({"ImageData1/Image1": None}, "pictures of numbers, got 0 of"),
        ({"ImageData1/Image2": b"short"}, "bytes of a picture, got 5"),
    ],
)
def test_what_is_wrong_is_named(write, changes, message):
    with pytest.raises(ValueError, match=message):
        tps.load_scan(write(changes))


@pytest.fixture
def write_views(tmp_path):
    """Write one file a view; the changes of a file replace or (None) remove its streams, None removes the file."""

    def written(changes=None):
        for name, streams in single_views(pictures_of(marked())).items():
            own = (changes or {}).get(name, {})
            if own is not None:
                kept = {key: value for key, value in (streams | own).items() if value is not None}
                (tmp_path / name).write_bytes(compound_file(kept))
        return tmp_path

    return written


def test_one_file_a_view_is_what_one_file_of_all_is(write, write_views, monkeypatch):
    whole = tps.load_scan(write())
    (path := write_views()).joinpath("marker.txrm").unlink()
    closed, close = [], CompoundFile.__del__
    monkeypatch.setattr(CompoundFile, "__del__", lambda self: (close(self), closed.append(self.path)))
    scan = tps.load_scan(path)
    np.testing.assert_array_equal(scan.projections, whole.projections)
    np.testing.assert_array_equal(scan.proj_geom["Vectors"], whole.proj_geom["Vectors"])
    assert scan.name == path.name and len(closed) > 48, "files of views do not stay open"


def test_views_of_an_exposure_of_their_own(write_views):
    exact = tps.load_scan(path := write_views())
    scan = tps.load_scan(write_views({"marker_0007.xrm": {"ImageInfo/ExpTimes": floats(1.0)}}))
    longer = exact.projections + np.log(2) * (np.arange(48) == 6)[:, None]
    np.testing.assert_allclose(scan.projections, longer, atol=1e-5)
    assert "pictures of 0.5 to 1 s are compared with an open beam of 0.5 s" in guesses(scan)
    path.joinpath("marker_ref.xrm").unlink()
    np.testing.assert_array_equal(tps.load_scan(path, views=(0, 6)).views, 6)
    assert "no flat field" in guesses(tps.load_scan(path))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"ImageInfo/Angles": None}, "ImageInfo/Angles: expected .* of 48 pictures, got 47"),
        ({"ImageInfo/NoOfImages": np.array(2, "<i4").tobytes()}, None),
        (
            {"ImageData1/Image1": None},
            "one picture in each of several .xrm files, got 0 in .*marker_0002.xrm",
        ),
        (
            {"ImageInfo/ImageWidth": np.array(30, "<i4").tobytes()},
            r"uint16 of \(33, 37\) as in marker_0001.xrm, got uint16 of \(33, 30\)",
        ),
        ({"Alignment/X-Shifts": floats(np.inf)}, "X-Shifts, Y-Shifts: expected finite numbers"),
    ],
)
def test_a_view_that_is_wrong_is_named(write_views, changes, message):
    path = write_views({"marker_0002.xrm": changes})
    if message is None:
        assert tps.load_scan(path).views == 48
        return
    with pytest.raises(ValueError, match=message):
        tps.load_scan(path)


def test_a_reconstruction_and_two_scans_are_refused(write):
    with pytest.raises(ValueError, match="name the .txrm file"):
        tps.load_scan(write(name="volume.txm"))
    write(name="a.txrm")
    with pytest.raises(ValueError, match="one scan in the folder, got a.txrm, b.txrm"):
        tps.load_scan(write(name="b.txrm").parent)


def test_damage_is_refused_in_our_words(write):
    """Whatever bytes are wrong, it is read or refused with a ValueError."""
    path = write()
    whole, refused = bytearray(path.read_bytes()), 0
    draw = np.random.default_rng(0)
    for trial in range(25):
        damaged = bytearray(whole)
        # The header and its directory, which lies at the end with the tables.
        ends = (4, 512) if trial % 2 else (len(whole) - 12000, len(whole))
        for place in draw.integers(*ends, 40):
            damaged[place] = draw.integers(256)
        path.write_bytes(damaged[: len(whole) - 3000 * (trial % 3)])
        try:
            tps.load_scan(path, views=24)
        except (ValueError, MemoryError):
            refused += 1
    assert refused > 12

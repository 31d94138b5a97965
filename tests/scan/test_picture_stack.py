"""A plain stack of TIFFs: what is stated, what is guessed and said, and which part is read."""

import logging
import time

import numpy as np
import pytest
import tifffile
from folders import STATED, marked, require_the_same_volume

import tomo_polysplat as tps
from tomo_polysplat.scan.geometry import from_astra
from tomo_polysplat.scan.readers.edf import EdfFrames
from tomo_polysplat.scan.readers.picture_files import frames_of
from tomo_polysplat.simulate.folders.arrays import edf_bytes
from tomo_polysplat.simulate.folders.scene import pictures_of
from tomo_polysplat.simulate.folders.write import write_folder


def test_counts_become_line_integrals_through_flats_and_darks(tiff_stack):
    scan = tps.load_scan(tiff_stack)
    assert scan.valid is None and scan.name == "sample" and scan.unit == "mm"
    # Counts are whole numbers: half of one in the 30000 behind nothing.
    np.testing.assert_allclose(scan.projections, marked().projections, atol=1e-4)


def test_arguments_say_what_the_toml_file_says(bare, tiff_stack):
    scan, told = tps.load_scan(bare, scanner=STATED), tps.load_scan(tiff_stack)
    np.testing.assert_array_equal(scan.projections, told.projections)
    assert scan.proj_geom.keys() == told.proj_geom.keys()
    np.testing.assert_allclose(scan.proj_geom["Vectors"], told.proj_geom["Vectors"], atol=1e-12)
    assert scan.spectrum is None  # the tube stands in the file only


def test_a_pixel_of_another_unit_goes_around_the_source(bare):
    with pytest.raises(ValueError, match=r"pixel: expected a detector within 130 degrees.*one unit"):
        tps.load_scan(bare, scanner=STATED | {"pixel": 1600.0})
    wide = tps.load_scan(bare, scanner=STATED | {"pixel": 16.0, "offset": (0.0, 0.0)})
    assert "the source sees the detector under 100 degrees" in " | ".join(wide.notes["scanner"]["guessed"])


def test_pictures_that_are_missing_are_said(bare):
    names = sorted(file.name for file in bare.iterdir())
    (bare / [name for name in names if name.startswith("proj")][7]).unlink()
    gap = " | ".join(tps.load_scan(bare, scanner=STATED).notes["scanner"]["guessed"])
    assert "the numbers of the pictures jump (6 to 8): steps are taken to be even" in gap


def test_angles_that_are_stated_stand_over_the_arc_of_the_file(tiff_stack):
    told = tps.load_scan(tiff_stack)
    scan = tps.load_scan(tiff_stack, scanner={"degrees": np.arange(48) * 7.5})
    np.testing.assert_allclose(scan.proj_geom["Vectors"], told.proj_geom["Vectors"], atol=1e-9)


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_a_toml_file_of_a_windows_program(bare, tiff_stack, encoding):
    told = tps.load_scan(tiff_stack)
    text = (tiff_stack / "scan.toml").read_text()
    (bare / "scan.toml").write_bytes(text.replace("\n", "\r\n").encode(encoding))
    np.testing.assert_array_equal(tps.load_scan(bare).proj_geom["Vectors"], told.proj_geom["Vectors"])


def test_pictures_sorted_into_folders_and_angles_from_a_file(tmp_path):
    pictures = pictures_of(marked())
    for name, frames in (
        ("Flats", pictures.flats),
        ("dark_field", pictures.darks),
        ("proj", pictures.projections),
    ):
        (tmp_path / name).mkdir()
        for k, frame in enumerate(frames):
            # Picture 10 comes after picture 9, whatever the letters say.
            tifffile.imwrite(tmp_path / name / f"a{k}.tiff", frame)
    lines = [f"{k} {angle}" for k, angle in enumerate(pictures.degrees)]
    (tmp_path / "angles.txt").write_text("# view and degrees\n" + "\n".join(lines))
    stated = {key: value for key, value in STATED.items() if key != "arc"} | {"degrees": "angles.txt"}
    require_the_same_volume(tps.load_scan(tmp_path, scanner=stated), marked())


def test_one_file_of_many_pictures_seen_from_behind_and_upside_down(tmp_path):
    """A panel is often read out from its back, and a picture may begin at the bottom."""
    pictures = pictures_of(marked())
    turned = {"first_row": "bottom", "seen_from": "detector", "flats": "flats.tif", "darks": "darks.tif"}
    for name in ("projections", "flats", "darks"):
        frames = getattr(pictures, name)[:, ::-1, ::-1]
        tifffile.imwrite(tmp_path / f"{name}.tif", frames, photometric="minisblack")
    scan = tps.load_scan(tmp_path / "projections.tif", scanner=STATED | turned)
    require_the_same_volume(scan, marked())


def test_a_parallel_beam(tmp_path):
    own = marked("parallel")
    write_folder("tiffs", tmp_path / "sample", own)
    (tmp_path / "sample" / "scan.toml").unlink()
    stated = {"beam": "parallel", "pixel": 0.64, "offset": (0.96, 0.0)}
    require_the_same_volume(tps.load_scan(tmp_path / "sample", scanner=stated), own)


def test_rows_columns_views_and_binning(tiff_stack):
    whole = tps.load_scan(tiff_stack)
    part = tps.load_scan(tiff_stack, rows=(2, 31), columns=(5, 36), views=(1, 47, 3), binning=2)
    assert part.projections.shape == (14, 16, 15)
    # The light of four pixels: rows run upwards in the scan, downwards in the pictures.
    light = np.exp(-whole.projections.astype(np.float64))
    four = light[33 - 4 : 33 - 2, 1, 5:7].mean()
    assert -np.log(four) == pytest.approx(part.projections[13, 0, 0], abs=2e-3)
    # A point falls on the same place of the detector.
    point = np.array([[3.0, -2.0, 1.0]])
    fine, coarse = (
        from_astra(scan.proj_geom, scan.vol_geom)[0].project_points(point) for scan in (whole, part)
    )
    first = np.array([5, 33 - 2 - 28])
    np.testing.assert_allclose(coarse[:, 0], (fine[1:47:3, 0] - first - 0.5) / 2, atol=1e-9)
    assert from_astra(part.proj_geom, part.vol_geom)[1].voxel_size[0] == pytest.approx(2 * 0.64)


def test_the_package_s_own_file_in_part(tiff_stack, tmp_path):
    tps.save_scan(tps.load_scan(tiff_stack), tmp_path / "scan.h5")
    # Its rows ascend with z: the same part is counted from the other end.
    ours = tps.load_scan(tmp_path / "scan.h5", rows=(3, 31), columns=(5, 35), views=3, binning=2)
    pictures = tps.load_scan(tiff_stack, rows=(2, 30), columns=(5, 35), views=3, binning=2)
    np.testing.assert_allclose(ours.projections, pictures.projections, atol=2e-3)
    np.testing.assert_allclose(ours.proj_geom["Vectors"], pictures.proj_geom["Vectors"], atol=1e-9)


def test_saturated_dead_and_dark_pixels_are_marked(tmp_path):
    pictures = pictures_of(marked())
    pictures.projections[3, 4, 5] = 65535
    pictures.projections[6, 7, 8] = 100
    pictures.flats[:, 9, 10] = 100
    from tomo_polysplat.simulate.folders import tiffs

    tiffs.write(tmp_path, pictures)
    scan = tps.load_scan(tmp_path)
    assert scan.notes["rays"] == {"not_finite": 0, "saturated": 1, "dead_pixel": 48, "no_light": 1}
    assert not scan.valid[33 - 1 - 4, 3, 5] and scan.projections[33 - 1 - 7, 6, 8] == np.inf
    binned = tps.load_scan(tmp_path, binning=3)
    # Of 33 rows from the top, 11 squares: the saturated pixel is in the second, and so is the whole square.
    assert not binned.valid[11 - 1 - 1, 3, 1]


def test_what_is_guessed_is_said(bare, caplog):
    for file in [*bare.glob("flat*"), *bare.glob("dark*")]:
        file.unlink()
    with caplog.at_level(logging.WARNING):
        scan = tps.load_scan(bare, scanner={"sod": 100, "sdd": 250, "pixel": 1.6})
    for words in ("no flat field", "no angles: 48 views", "on the detector's middle"):
        assert words in caplog.text and any(words in guess for guess in scan.notes["scanner"]["guessed"])


@pytest.mark.parametrize(
    ("stated", "message"),
    [
        ({}, "the distances and the pixel of the scanner.*--sod, --sdd, --pixel"),
        ({"pixel": 1.6, "sod": 100.0}, "both distances of a cone beam, got not both"),
        (STATED | {"sdd": 50.0}, "source_detector: expected at least source_object"),
        (STATED | {"degrees": np.arange(5.0)}, "degrees, arc: expected one of the two"),
        ({**STATED, "arc": None, "degrees": np.arange(5.0)}, "one angle for each of 48 pictures, got 5"),
        (STATED | {"piksel": 1.0}, "did you mean pixel"),
        (STATED | {"filter": "a bit of metal"}, "a material and its thickness"),
        (STATED | {"flats": "none_*.tif"}, "flats: .* of which there is none"),
        (STATED | {"seen_from": "above"}, "one of source, detector"),
        (STATED | {"unit": "inch"}, "unit: expected one of"),
    ],
)
def test_what_does_not_fit_is_refused(bare, stated, message):
    with pytest.raises(ValueError, match=message):
        tps.load_scan(bare, scanner=stated)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        ({"rows": (5, 99)}, "rows: expected first < end, from 0 to 33, got 5, 99"),
        ({"views": 0}, "views: expected a positive whole number"),
        ({"views": 48}, "views: expected a step that leaves some of 48 views, got 48; 2 takes every other"),
        ({"binning": 50}, "binning: expected at most the 33 rows"),
        ({"columns": 7}, "columns: expected two whole numbers"),
    ],
)
def test_a_part_outside_the_pictures_is_refused(tiff_stack, part, message):
    with pytest.raises(ValueError, match=message):
        tps.load_scan(tiff_stack, **part)


def test_pictures_that_do_not_go_together_are_refused(bare):
    tifffile.imwrite(bare / "flat_0009.tif", np.ones((5, 6), np.uint16))
    with pytest.raises(ValueError, match=r"\(33, 37\) as in flat_0000.tif, got uint16 of \(5, 6\)"):
        tps.load_scan(bare, scanner=STATED)
    (bare / "flat_0009.tif").write_bytes(b"II*\0 something else")
    with pytest.raises(ValueError, match="a readable TIFF file"):
        tps.load_scan(bare, scanner=STATED)


def test_a_folder_without_pictures_is_refused(tmp_path):
    with pytest.raises(
        ValueError, match="a Data Exchange HDF5 file, an .npz scan, or one of: .*stack of TIFFs, EDF or"
    ):
        tps.load_scan(tmp_path)
    with pytest.raises(FileNotFoundError):
        tps.load_scan(tmp_path / "missing")


def test_texts_of_files_are_shown_as_they_are(tiff_stack, bare):
    text = (tiff_stack / "scan.toml").read_text() + 'comment = "\\u001b[31mred"\n'
    (bare / "scan.toml").write_text(text)
    keys = tps.load_scan(bare).notes["scanner"]["keys"]
    assert keys == {"operator": "nobody", "comment": "\\x1b[31mred"}


def test_edf_of_another_byte_order_size_and_damage(tmp_path):
    """Type, size and order stand in the header; more pictures may follow, and blanks after them."""
    picture = (np.arange(35) * 0.25).reshape(5, 7).astype(">f4")
    after = (picture + 1).astype(">f4")
    file = tmp_path / "a.edf"
    file.write_bytes(edf_bytes(picture, motor_pos="1 2") + edf_bytes(after) + b"\n\n")
    frames = EdfFrames([file])
    assert frames.shape == (2, 5, 7) and frames.dtype == np.dtype(">f4")
    np.testing.assert_array_equal(frames.read(1, slice(1, 3), slice(2, 7)), after[1:3, 2:7])
    for content, message in (
        (edf_bytes(picture)[:-1], "140 bytes of a picture, got 139"),
        (b"{ Dim_1 = 5 ;", "one without an end"),
        (b"something else", "begins with {"),
        (edf_bytes(picture).replace(b"FloatValue", b"ComplexVal"), "pictures of numbers"),
        (edf_bytes(picture, Compression="GzipCompression"), "not compressed"),
        (edf_bytes(picture).replace(b"Dim_2 = 5", b"Dim_2 = 0"), "of two axes"),
    ):
        file.write_bytes(content)
        with pytest.raises(ValueError, match=message):
            EdfFrames([file])


def test_npy_pictures_in_one_file_or_one_in_each(tmp_path):
    stack = np.arange(2 * 3 * 4, dtype=np.uint16).reshape(2, 3, 4)
    np.save(tmp_path / "all.npy", stack)
    for k, picture in enumerate(stack):
        np.save(tmp_path / f"{k}.npy", picture)
    for names in (["all.npy"], ["0.npy", "1.npy"]):
        frames = frames_of([tmp_path / name for name in names])
        assert frames.shape == (2, 3, 4)
        np.testing.assert_array_equal(frames.read(1, slice(1, 3), slice(0, 2)), stack[1, 1:3, :2])
    np.save(tmp_path / "1.npy", stack[0, :2])
    with pytest.raises(ValueError, match=r"as in 0.npy, got uint16 of \(2, 4\)"):
        frames_of([tmp_path / "0.npy", tmp_path / "1.npy"]).read(1, slice(0, 1), slice(0, 1))
    np.save(tmp_path / "texts.npy", np.array([["a"]]))
    with pytest.raises(ValueError, match=r"one stack \(pictures, rows, columns\)"):
        frames_of([tmp_path / "texts.npy"])
    with pytest.raises(ValueError, match="pictures of one kind of file, got .npy, .tif"):
        frames_of([tmp_path / "0.npy", tmp_path / "0.tif"])


def test_npz_stacks_with_their_angles_and_without(tmp_path):
    pictures = pictures_of(marked())
    path, stated = tmp_path / "a.npz", {key: value for key, value in STATED.items() if key != "arc"}
    order = np.random.default_rng(0).permutation(48)
    arrays = {"data": pictures.projections[order], "flat": pictures.flats[0], "dark": pictures.darks}
    np.savez(path, **arrays, theta=pictures.degrees[order])
    require_the_same_volume(tps.load_scan(path, scanner=stated), marked())
    np.savez(path, **arrays)
    scan = tps.load_scan(tmp_path, scanner=stated)
    assert "no angles: 48 views" in " ".join(scan.notes["scanner"]["guessed"])
    np.savez(path, **arrays, theta=np.deg2rad(pictures.degrees[order]))
    with pytest.raises(ValueError, match="0 to 6.15, which look like radians"):
        tps.load_scan(path, scanner=stated)
    with pytest.raises(ValueError, match="the distances and the pixel of the scanner"):
        tps.load_scan(path, scanner={"arc": 360})


def test_an_edf_header_of_blanks_takes_no_time(tmp_path):
    picture = np.arange(35, dtype="u2").reshape(5, 7)
    content = edf_bytes(picture)
    (tmp_path / "a.edf").write_bytes(content.replace(b"}\n", b" " * 64_000 + b"}\n", 1))
    begun = time.process_time()
    frames = EdfFrames([tmp_path / "a.edf"])
    assert time.process_time() - begun < 1.0  # by a pattern with blanks in two places it was 20
    np.testing.assert_array_equal(frames.read(0, slice(0, 5), slice(0, 7)), picture)


@pytest.mark.parametrize("kind", ["uint8", "uint16", "int32", "uint32", "float32", "float64"])
def test_edf_as_fabio_writes_it(kind, tmp_path):
    """The library of the ESRF's, one picture in a file and several."""
    edfimage = pytest.importorskip("fabio.edfimage", reason="python -m pip install fabio")
    pictures = np.random.default_rng(1).integers(0, 200, (3, 5, 7)).astype(kind)
    image = edfimage.EdfImage(data=pictures[0], header={"motor_pos": "1 2"})
    image.write(str(tmp_path / "one.edf"))
    for more in pictures[1:]:
        image.append_frame(data=more)
    image.write(str(tmp_path / "several.edf"))
    for name, expected in (("one", pictures[:1]), ("several", pictures)):
        frames = EdfFrames([tmp_path / f"{name}.edf"])
        found = [frames.read(k, slice(None), slice(None)) for k in range(frames.shape[0])]
        np.testing.assert_array_equal(found, expected)
        assert frames.dtype == pictures.dtype


def test_flats_that_are_not_named_are_no_projections(tiff_stack):
    """One flat is enough to name; the others must not become views, which would shift all angles."""
    scan = tps.load_scan(tiff_stack, scanner={"flats": "flat_0001.tif"})
    np.testing.assert_array_equal(scan.projections, tps.load_scan(tiff_stack).projections)


def test_pictures_that_all_have_a_word_for_flats_are_the_object_s(tiff_stack, tmp_path):
    for file in tiff_stack.glob("proj_*.tif"):
        (tmp_path / file.name.replace("proj", "open_door")).symlink_to(file)
    scan = tps.load_scan(tmp_path, scanner=STATED | {"flats": tiff_stack / "flat_0001.tif"})
    assert scan.views == 48


def test_eight_bits_are_said(tiff_stack, tmp_path):
    for file in tiff_stack.glob("*.tif"):
        tifffile.imwrite(tmp_path / file.name, (tifffile.imread(file) >> 8).astype(np.uint8))
    said = " ".join(tps.load_scan(tmp_path, scanner=STATED).notes["scanner"]["guessed"])
    assert "8 bits, 256 grey values" in said


def test_what_tifffile_logs_of_its_own_is_still_there_for_others(bare, caplog):
    """A torn picture is told once, by our own exception; a caller's reads log as ever."""
    torn = bare / "proj_0005.tif"
    start = torn.read_bytes()[:200]
    torn.unlink()
    torn.write_bytes(start)
    with pytest.raises(ValueError, match="readable TIFF"):
        tps.load_scan(bare, scanner=STATED)
    assert not caplog.records
    with pytest.raises(Exception, match=r"."), tifffile.TiffFile(torn) as file:
        file.pages[0].asarray()
    assert caplog.records


def test_the_only_folder_of_pictures_is_that_of_the_object(tiff_stack, tmp_path):
    """Flats and darks beside it; a folder of slices is another thing, and of two others none is taken."""
    (tmp_path / "tiffs").mkdir()
    for file in tiff_stack.glob("*.tif"):
        place = tmp_path / "tiffs" if file.name.startswith("proj") else tmp_path
        (place / file.name).symlink_to(file)
    expected = tps.load_scan(tiff_stack, scanner=STATED)
    np.testing.assert_array_equal(tps.load_scan(tmp_path, scanner=STATED).projections, expected.projections)
    for name in ("slices", "other"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "a.tif").symlink_to(next(tiff_stack.glob("proj*.tif")))
        if name == "slices":
            assert tps.load_scan(tmp_path, scanner=STATED).views == expected.views
    with pytest.raises(ValueError, match=r"pictures of an object .*--projections"):
        tps.load_scan(tmp_path, scanner=STATED)


def test_line_integrals_are_not_taken_for_counts(tiff_stack, tmp_path):
    """Decimals around 0 in the air: refused until somebody says what they are; transmission has air near 1."""
    lines = tps.load_scan(tiff_stack).projections.transpose(1, 0, 2)[:, ::-1]
    np.save(tmp_path / "proj.npy", lines)
    with pytest.raises(ValueError, match=r"input: expected counts.*% of them 0 or less.*attenuation"):
        tps.load_scan(tmp_path, scanner=STATED)
    with pytest.raises(ValueError, match="of them 0 or less"):
        tps.load_scan(tmp_path, scanner=STATED, input="counts")
    scan = tps.load_scan(tmp_path, scanner=STATED, input="attenuation")
    np.testing.assert_array_equal(scan.projections, lines[:, ::-1].transpose(1, 0, 2))
    np.save(tmp_path / "proj.npy", np.exp(-lines))
    assert tps.load_scan(tmp_path, scanner=STATED).valid is None


def test_several_guesses_are_one_warning_of_a_line_each(bare, caplog):
    for file in bare.glob("flat*"):
        file.unlink()
    stated = {key: value for key, value in STATED.items() if key != "offset"}
    with caplog.at_level(logging.WARNING):
        guessed = tps.load_scan(bare, scanner=stated).notes["scanner"]["guessed"]
    (record,) = (one for one in caplog.records if "guessed" in one.message)
    assert len(guessed) > 2 and record.message.split("\n  - ")[1:] == guessed

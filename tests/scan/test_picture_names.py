"""Which pictures of a plain stack are which, by their names, and how many a file holds."""

import numpy as np
import pytest
import tifffile
from folders import STATED, marked

import tomo_polysplat as tps
from tomo_polysplat.simulate.folders.write import write_folder


def link(files, place):
    for file in files:
        (place / file.name).symlink_to(file)


def guesses(scan):
    return " | ".join(scan.notes["scanner"]["guessed"])


def test_pictures_of_other_names_are_no_views(bare, tiff_stack):
    expected = tps.load_scan(bare, scanner=STATED)
    one = next(tiff_stack.glob("proj_*.tif"))
    for name in ("proj_scout_000.tif", "proj_scout_090.tif", "Preview.tif"):
        (bare / name).symlink_to(one)
    scan = tps.load_scan(bare, scanner=STATED)
    np.testing.assert_array_equal(scan.projections, expected.projections)
    assert "other names are passed over: Preview.tif, proj_scout_000.tif, proj_scout_090.tif" in guesses(scan)


def test_two_scans_in_one_folder_are_told_apart_by_somebody(bare):
    for number, file in enumerate(sorted(bare.glob("proj_*.tif"))):
        file.rename(bare / f"{'first' if number % 2 else 'second'}_{number:04}.tif")
    with pytest.raises(ValueError, match="one name and different numbers.*24 as first_0001.tif.*projections"):
        tps.load_scan(bare, scanner=STATED)
    assert tps.load_scan(bare, scanner=STATED | {"projections": "first*.tif"}).views == 24


def test_angles_in_names_are_numbers(bare):
    for number, file in enumerate(sorted(bare.glob("proj_*.tif"))):
        file.rename(bare / f"sample_{7.5 * number:g}deg.tif")
    assert tps.load_scan(bare, scanner=STATED).views == 48


def test_flats_and_darks_by_the_words_of_panels_and_programs(bare):
    expected = tps.load_scan(bare, scanner=STATED)
    for kind, names in (("flat", ("GainImage", "FlatAfter")), ("dark", ("OffsetImage", "darkend"))):
        for number, file in enumerate(sorted(bare.glob(f"{kind}_*.tif"))):
            file.rename(bare / f"{names[number % 2]}{number:04}.tif")
    np.testing.assert_array_equal(tps.load_scan(bare, scanner=STATED).projections, expected.projections)


def test_a_word_that_all_pictures_have_tells_of_the_sample(bare):
    for file in [*bare.glob("flat_*.tif"), *bare.glob("dark_*.tif")]:
        file.unlink()
    for file in bare.glob("proj_*.tif"):
        file.rename(bare / file.name.replace("proj", "white_rice"))
    scan = tps.load_scan(bare, scanner=STATED | {"white": 30000})
    assert scan.views == 48


def test_a_picture_of_another_kind_hides_no_scan(tiff_stack, tmp_path):
    write_folder("edf", tmp_path / "edf", marked())
    expected = tps.load_scan(tmp_path / "edf")
    tifffile.imwrite(tmp_path / "edf" / "preview.tif", np.zeros((4, 4), np.uint8))
    np.testing.assert_array_equal(tps.load_scan(tmp_path / "edf").projections, expected.projections)


def test_one_picture_is_no_scan(bare):
    for file in sorted(bare.glob("proj_*.tif"))[1:]:
        file.unlink()
    with pytest.raises(ValueError, match="at least two views"):
        tps.load_scan(bare, scanner=STATED)


@pytest.mark.parametrize("order", ["<", ">"])
def test_a_large_stack_of_imagej_has_one_entry_for_all_its_pictures(order, tiff_stack, tmp_path):
    """ImageJ writes more than 4 GB so; tifffile does where it is asked to."""
    stack = np.stack([tifffile.imread(file) for file in sorted(tiff_stack.glob("proj_*.tif"))])
    link(tiff_stack.glob("[fd]*.tif"), tmp_path)
    with tifffile.TiffWriter(tmp_path / "stack.tif", imagej=True, byteorder=order) as file:
        file.write(stack, truncate=True)
    scan = tps.load_scan(tmp_path, scanner=STATED)
    np.testing.assert_array_equal(scan.projections, tps.load_scan(tiff_stack).projections)
    (tmp_path / "stack.tif").write_bytes((tmp_path / "stack.tif").read_bytes()[:-9])
    with pytest.raises(ValueError, match="readable TIFF.*copy or write"):
        tps.load_scan(tmp_path, scanner=STATED)


def test_several_files_of_several_pictures_and_small_ones_for_a_viewer(tiff_stack, tmp_path):
    for number, file in enumerate(sorted(tiff_stack.glob("proj_*.tif"))):
        picture = tifffile.imread(file)
        with tifffile.TiffWriter(tmp_path / f"proj_{number:04}.tif") as tiff:
            tiff.write(picture)
            tiff.write(picture[::4, ::4], subfiletype=1)
    link(tiff_stack.glob("dark*.tif"), tmp_path)
    flats = np.stack([tifffile.imread(file) for file in sorted(tiff_stack.glob("flat_*.tif"))])
    for name, some in (("flat_before", flats[:2]), ("flat_after", flats[2:])):
        tifffile.imwrite(tmp_path / f"{name}.tif", some, photometric="minisblack")
    scan = tps.load_scan(tmp_path, scanner=STATED)
    np.testing.assert_allclose(scan.projections, tps.load_scan(tiff_stack).projections, atol=1e-6)

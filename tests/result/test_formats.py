"""Volumes in other programs' files, read back by other libraries: numbers, voxel size, unit, place and handedness."""

import json

import numpy as np
import pytest
import SimpleITK
import tifffile
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkIOXML import vtkXMLImageDataReader

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import VolumeGrid

# Voxels of 0.5 x 0.3 x 0.7 mm, an odd number along every axis, and no axis through the middle.
GRID = VolumeGrid((3, 5, 7), (-1.0, 2.0, 10.0), (2.5, 3.5, 12.1))
# An index (z, y, x) off every axis of symmetry, and where its centre is, (x, y, z).
MARKER, PLACE = (2, 1, 5), (-1.0 + 5.5 * 0.5, 2.0 + 1.5 * 0.3, 10.0 + 2.5 * 0.7)
ITK = ("mha", "nrrd", "nii", "nii.gz")


def marked(unit="mm", grid=GRID, **options):
    """A volume of noise about 0.2 per unit with one voxel of twice as much."""
    mu = np.random.default_rng(3).uniform(0.1, 0.3, (1, *grid.shape)).astype(np.float32)
    if grid is GRID:
        mu[0][MARKER] = 0.6
    return Result(mu, grid, unit, 60.0, **options)


def marker_of(array):
    return tuple(int(i) for i in np.unravel_index(np.argmax(array), array.shape))


def saved(tmp_path, ending, result=None, **options):
    path = tmp_path / f"volume.{ending}"
    (result or marked()).save(path, **options)
    return str(path)


@pytest.mark.parametrize("ending", ITK)
@pytest.mark.parametrize(("unit", "mm"), [("mm", 1.0), ("cm", 10.0), ("um", 1e-3)])
def test_itk_reads_the_volume_where_it_is(tmp_path, ending, unit, mm):
    image = SimpleITK.ReadImage(saved(tmp_path, ending, marked(unit)))
    np.testing.assert_array_equal(SimpleITK.GetArrayFromImage(image), marked(unit).volume)
    np.testing.assert_allclose(image.GetSpacing(), np.array([0.5, 0.3, 0.7]) * mm, rtol=1e-6)
    place = image.TransformIndexToPhysicalPoint(MARKER[::-1])
    np.testing.assert_allclose(place, np.array(PLACE) * mm, rtol=1e-6)
    assert np.linalg.det(np.reshape(image.GetDirection(), (3, 3))) > 0.999


@pytest.mark.parametrize("ending", ["nii", "nii.gz"])
def test_nibabel_finds_x_and_y_turned_as_nifti_has_them(tmp_path, ending):
    import nibabel

    image = nibabel.load(saved(tmp_path, ending))
    array = image.get_fdata()
    assert marker_of(array) == MARKER[::-1] and image.header.get_xyzt_units()[0] == "mm"
    x, y, z = PLACE
    for affine in (image.get_sform(), image.get_qform()):
        place = nibabel.affines.apply_affine(affine, MARKER[::-1])
        np.testing.assert_allclose(place, (-x, -y, z), rtol=1e-6)
    assert b"1/mm at 60 keV" in image.header["descrip"].item()
    assert 0 == image.header["cal_min"] < image.header["cal_max"] <= 0.67


def read_vti(path):
    reader = vtkXMLImageDataReader()
    reader.SetFileName(path)
    reader.Update()
    return reader.GetOutput()


@pytest.mark.parametrize("bits", [32, 16])
def test_paraview_reads_the_volume_where_it_is(tmp_path, bits):
    image = read_vti(saved(tmp_path, "vti", bits=bits))
    scalars = image.GetPointData().GetScalars()
    assert scalars.GetName() == "attenuation (1/mm)"
    array = vtk_to_numpy(scalars).reshape(GRID.shape)
    assert marker_of(array) == MARKER
    np.testing.assert_allclose(image.GetPoint(int(np.argmax(array.ravel()))), PLACE, rtol=1e-9)
    fields = image.GetFieldData()
    slope, offset = (fields.GetArray(name).GetValue(0) for name in ("slope", "offset"))
    np.testing.assert_allclose(slope * array + offset, marked().volume, atol=4e-6)
    assert fields.GetAbstractArray("length_unit").GetValue(0) == "mm"
    assert fields.GetArray("energy_kev").GetValue(0) == 60


def imagej(path):
    """Voxel size, unit, the line to the quantity and its unit, and the array, as ImageJ takes them from a TIFF."""
    with tifffile.TiffFile(path) as file:
        tags, known = file.pages[0].tags, file.imagej_metadata
        across, down = (tags[f"{axis}Resolution"].value for axis in "XY")
        size = (across[1] / across[0], down[1] / down[0], known["spacing"])
        line = (known.get("c0", 0.0), known.get("c1", 1.0)) if known.get("cf", 0) == 0 else None
        return size, known["unit"], line, known, file.asarray()


@pytest.mark.parametrize("bits", [32, 16])
@pytest.mark.parametrize("unit", ["mm", "um"])
def test_imagej_opens_a_stack_with_its_scale(tmp_path, unit, bits):
    size, known_unit, (c0, c1), known, array = imagej(saved(tmp_path, "tif", marked(unit), bits=bits))
    np.testing.assert_allclose(size, (0.5, 0.3, 0.7), rtol=1e-6)
    assert known_unit == unit and known["slices"] == 3 and marker_of(array) == MARKER
    np.testing.assert_allclose(c0 + c1 * array, marked().volume, atol=4e-6)
    low, high = c0 + c1 * known["min"], c0 + c1 * known["max"]
    assert 0 <= low < 0.11 and 0.5 < high <= 0.67, "the window shows the object"
    assert bits == 32 or known["vunit"] == f"1/{unit}"
    # ImageJ's x is (column - origin) * width at the left edge of a column.
    np.testing.assert_allclose((5.5 - known["xorigin"]) * size[0], PLACE[0], rtol=1e-6)
    assert json.loads(known["Info"])["energy_kev"] == 60


def test_ome_has_lengths_with_their_units(tmp_path):
    with tifffile.TiffFile(saved(tmp_path, "ome.tif", marked("um"))) as file:
        pixels = tifffile.xml2dict(file.ome_metadata)["OME"]["Image"]["Pixels"]
        assert marker_of(file.asarray()) == MARKER and file.series[0].axes == "ZYX"
    for axis, size in zip("XYZ", (0.5, 0.3, 0.7)):
        assert pixels[f"PhysicalSize{axis}"] == size and pixels[f"PhysicalSize{axis}Unit"] == "µm"


def test_a_folder_of_slices_is_a_stack_with_its_scale(tmp_path):
    marked().save(f"{tmp_path}/stack/", bits=16)
    files = sorted((tmp_path / "stack").iterdir())
    assert [file.name for file in files] == [f"slice_000{n}.tif" for n in range(3)]
    parts = [imagej(file) for file in files]
    for size, unit, line, _, _ in parts:
        np.testing.assert_allclose(size, (0.5, 0.3, 0.7), rtol=1e-6)
        assert unit == "mm" and line == parts[0][2]
    assert marker_of(np.stack([part[-1] for part in parts])) == MARKER


def test_numbers_of_16_bits_are_within_half_a_step(tmp_path):
    import nibabel

    volume = marked().volume.astype(np.float64)
    image = nibabel.load(saved(tmp_path, "nii.gz", bits=16))
    step = np.ptp(volume) / 65535
    assert image.get_data_dtype() == np.uint16 and image.dataobj.slope == pytest.approx(step, rel=1e-6)
    assert abs(image.get_fdata().T - volume).max() < 0.51 * step
    about = SimpleITK.ReadImage(saved(tmp_path, "nrrd", bits=16))
    slope, offset = (float(about.GetMetaData(name)) for name in ("slope", "offset"))
    stored = SimpleITK.GetArrayFromImage(about)
    assert (stored.min(), stored.max()) == (0, 65535)
    assert abs(slope * stored + offset - volume).max() < 0.51 * step


@pytest.mark.parametrize("bits", [32, 16])
@pytest.mark.parametrize(("unit", "cm"), [("cm", 1.0), ("um", 1e-4)])
def test_water_has_no_hounsfield_units_and_nothing_minus_1000(tmp_path, unit, cm, bits):
    import nibabel

    water = mass_attenuation("water", 60.0) * cm
    mu = np.zeros((1, *GRID.shape))
    mu[0, 0], mu[0, 1] = water, 2 * water
    path = saved(tmp_path, "nii", Result(mu, GRID, unit, 60.0), hu=True, bits=bits)
    values = nibabel.load(path).get_fdata().T
    np.testing.assert_allclose(values[:, 0, 0], (0, 1000, -1000), atol=0.03)
    soft = Result(1.0 * Materials.mixture(np.zeros(GRID.shape)), GRID, unit, 75.0, Materials())
    soft.save(tmp_path / "soft.mha", hu=True)
    np.testing.assert_allclose(
        SimpleITK.GetArrayFromImage(SimpleITK.ReadImage(str(tmp_path / "soft.mha"))), 0, atol=0.01
    )


def test_a_slice_is_shown_as_astra_does_and_lies_where_it_is(tmp_path):
    """After a 2D scan y is upwards in pictures and in arrays, and ascends in files that have coordinates."""
    grid = VolumeGrid((1, 5, 7), (-1.0, 2.0, 10.0), (2.5, 3.5, 12.1))
    mu = np.zeros((1, 1, 5, 7))
    mu[0, 0, 1, 5] = 1
    result = Result(mu, grid, "mm", 60.0, flipped_2d=True)
    for ending in ("tif", "ome.tif"):
        assert marker_of(tifffile.imread(saved(tmp_path, ending, result)).reshape(5, 7)) == (3, 5)
    assert marker_of(np.load(saved(tmp_path, "npy", result))) == (3, 5)
    image = SimpleITK.ReadImage(saved(tmp_path, "mha", result))
    assert marker_of(SimpleITK.GetArrayFromImage(image)) == (0, 1, 5)
    np.testing.assert_allclose(image.TransformIndexToPhysicalPoint((5, 1, 0))[:2], PLACE[:2], rtol=1e-9)


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("volume.nrdd", {}, r"\.mha.*did you mean \.nrrd"),
        ("volume", {}, "a name ending in"),
        ("volume.h5", {"hu": True}, "the volume alone"),
        ("volume.npy", {"bits": 16}, "slope and offset"),
        ("volume.tif", {"bits": 12}, "16 or 32"),
    ],
)
def test_what_a_file_cannot_hold_is_refused(tmp_path, name, options, message):
    with pytest.raises(ValueError, match=message):
        marked().save(tmp_path / name, **options)
    assert not list(tmp_path.iterdir())


def test_hounsfield_units_need_an_energy_and_a_unit(tmp_path):
    for result, message in (
        (Result(marked().basis, GRID, "mm"), "energy"),
        (marked("pixel"), "lengths"),
    ):
        with pytest.raises(ValueError, match=f"hu: .*{message}"):
            result.save(tmp_path / "v.tif", hu=True)


def test_one_tiff_ends_at_4_gib_and_says_what_does_not(tmp_path, monkeypatch):
    monkeypatch.setattr("tomo_polysplat.result.tiff._LARGEST_TIFF", 105 * 4 - 1)
    with pytest.raises(ValueError, match="4 GiB.*slices"):
        marked().save(tmp_path / "v.tif")
    marked().save(tmp_path / "v.tif", bits=16)
    marked().save(tmp_path / "v.ome.tif")
    with tifffile.TiffFile(tmp_path / "v.ome.tif") as file:
        assert file.is_bigtiff and marker_of(file.asarray()) == MARKER

"""Volumes at any energy and material maps from the basis, and files that bring everything back."""

import json

import h5py
import numpy as np
import pytest

from tomo_polysplat.physics.base_materials import Materials
from tomo_polysplat.physics.materials import mass_attenuation
from tomo_polysplat.physics.spectrum import Spectrum
from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan import hdf5_map
from tomo_polysplat.scan.geometry import VolumeGrid
from tomo_polysplat.scan.io import load_scan

GRID = VolumeGrid((3, 4, 5), (-1.0, -2.0, -0.3), (1.5, 2.0, 0.3))


def polychromatic(u=0.3, density=1.7, **changes):
    """A result whose voxels all hold one material."""
    basis = density * Materials.mixture(np.broadcast_to(u, GRID.shape))
    content = {
        "basis": basis,
        "grid": GRID,
        "energy_kev": 55.0,
        "materials": Materials(),
        "spectrum": Spectrum([40.0, 70.0], [1, 1], "two lines"),
        "gaussians": {
            "position": np.arange(6.0).reshape(2, 3),
            "scale": np.ones((2, 3)),
            "rotation": np.tile([1.0, 0, 0, 0], (2, 1)),
            "density": np.array([1.0, 2.0]),
            "u": np.array([0.1, 0.9]),
        },
        "history": [{"seconds": 0.5, "iteration": 3, "loss": np.float32(0.25), "held_out": None}],
        "plan": {"curves": Answer(3, "a spectrum is given", Status.ASKED, {"voxels": 7})},
        "counts": {"masked_rays": np.int64(4)},
        "settings": {"passes": 2.0},
        "provenance": {"geometry": "cone beam, 9 views"},
        "seconds": 1.25,
    }
    return Result(**(content | changes))


@pytest.mark.parametrize(("unit", "cm"), [("cm", 1.0), ("mm", 0.1), ("um", 1e-4), ("m", 100.0)])
def test_pure_materials_have_their_tabulated_attenuation(unit, cm):
    for u, name in ((0.0, "water"), (1.0, "iron")):
        result = polychromatic(u, density=2.0, unit=unit)
        for kev in (30.0, 55.0, 120.0):
            expected = 2.0 * mass_attenuation(name, kev) * cm
            np.testing.assert_allclose(result.attenuation(kev), expected, rtol=1e-5)
    np.testing.assert_allclose(result.volume, result.attenuation(55.0))
    assert result.volume.shape == GRID.shape and result.volume.dtype == np.float32


def test_material_and_density_are_recovered():
    u = np.linspace(0, 1, 60).reshape(GRID.shape)
    result = polychromatic(u, density=3.1)
    np.testing.assert_allclose(result.material, u, atol=1e-6)
    np.testing.assert_allclose(result.density, 3.1, rtol=1e-6)


def test_a_mixture_has_the_mean_material_of_its_mass():
    basis = 1.0 * Materials.mixture(np.full(GRID.shape, 0.2)) + 3.0 * Materials.mixture(
        np.full(GRID.shape, 0.6)
    )
    result = polychromatic(basis=basis)
    np.testing.assert_allclose(result.material, (1.0 * 0.2 + 3.0 * 0.6) / 4.0, rtol=1e-6)


def test_empty_space_has_no_material():
    density = np.ones(GRID.shape)
    density[0] = 0
    result = polychromatic(0.5, density=density)
    assert (result.material[0] == 0).all() and np.isfinite(result.material).all()
    np.testing.assert_allclose(result.material[1:], 0.5, rtol=1e-6)
    assert (polychromatic(0.5, density=0.0).material == 0).all()


def test_a_monochromatic_result_knows_one_energy_only():
    mu = np.random.default_rng(0).random((1, *GRID.shape))
    result = Result(mu, GRID, energy_kev=60.0)
    np.testing.assert_allclose(result.attenuation(60.0), mu[0], rtol=1e-6)
    with pytest.raises(ValueError, match="60 keV only"):
        result.attenuation(61.0)
    with pytest.raises(ValueError, match="energy is unknown"):
        Result(mu, GRID).attenuation(60.0)
    for name in ("material", "density"):
        with pytest.raises(ValueError, match="polychromatic"):
            getattr(result, name)


def test_two_dimensional_results_have_row_0_at_the_largest_y():
    grid = VolumeGrid((1, 4, 5), (-1, -1, -1), (1, 1, 1))
    mu = np.arange(20.0).reshape(1, 1, 4, 5)
    result = Result(mu, grid, flipped_2d=True)
    np.testing.assert_array_equal(result.volume, mu[0, 0, ::-1])
    assert result.volume.flags.c_contiguous


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"basis": np.zeros((1, 3, 4, 5))}, "basis: expected shape"),
        ({"energy_kev": None}, "energy_kev"),
        ({"flipped_2d": True}, "flipped_2d"),
        (
            {"gaussians": dict.fromkeys(("position", "scale", "rotation", "density", "u"), np.zeros(2))},
            "position",
        ),
    ],
)
def test_inconsistent_parts_are_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        polychromatic(**changes)


# Files


@pytest.mark.parametrize("flat", [False, True])
def test_everything_comes_back_from_a_file(tmp_path, flat):
    result = polychromatic(np.linspace(0, 1, 60).reshape(GRID.shape), unit="mm")
    if flat:
        grid = VolumeGrid((1, 4, 5), (-1, -1, -1), (1, 1, 1))
        result = polychromatic(basis=result.basis[:, :1], grid=grid, flipped_2d=True)
    result.save(tmp_path / "result.h5")
    back = Result.load(tmp_path / "result.h5")
    np.testing.assert_array_equal(back.volume, result.volume)
    np.testing.assert_array_equal(back.basis, result.basis)
    for name, values in result.gaussians.items():
        np.testing.assert_array_equal(back.gaussians[name], values, err_msg=name)
    for name in (
        "unit",
        "energy_kev",
        "materials",
        "spectrum",
        "plan",
        "settings",
        "provenance",
        "seconds",
        "flipped_2d",
    ):
        assert getattr(back, name) == getattr(result, name), name
    assert back.history == [{"seconds": 0.5, "iteration": 3, "loss": 0.25, "held_out": None}]
    assert back.counts == {"masked_rays": 4}
    np.testing.assert_array_equal([back.grid.lower, back.grid.upper], [result.grid.lower, result.grid.upper])


@pytest.mark.parametrize("kind", ["polychromatic", "monochromatic", "flat"])
def test_a_large_result_stays_in_its_file(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(hdf5_map, "_LARGE", 200)
    result = polychromatic(np.linspace(0, 1, 60).reshape(GRID.shape))
    if kind == "monochromatic":
        result = Result(np.random.default_rng(0).random((1, *GRID.shape)), GRID, unit="pixel")
    elif kind == "flat":
        grid = VolumeGrid((1, 4, 5), (-1, -1, -1), (1, 1, 1))
        result = polychromatic(basis=result.basis[:, :1], grid=grid, flipped_2d=True)
    path = tmp_path / "result.h5"
    result.save(path)
    back, before = Result.load(path), path.read_bytes()
    assert hdf5_map.is_mapped(back.basis) and hdf5_map.is_mapped(back.volume) == (kind != "flat")
    np.testing.assert_allclose(back.volume, result.volume, rtol=1e-6)
    np.testing.assert_array_equal(back.basis, result.basis)
    back.basis[0, 0] = 7.0
    back.volume[..., 0] = 9.0
    assert path.read_bytes() == before, "the file is as it was"
    back.save(path, overwrite=True)
    again = Result.load(path)
    assert (again.basis[0, 0] == 7.0).all()
    assert kind == "flat" or (again.volume[..., 0] == 9.0).all()


def test_a_large_result_that_was_damaged_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(hdf5_map, "_LARGE", 200)
    path = tmp_path / "result.h5"
    for name in ("exchange/data", "polysplat/basis"):
        polychromatic().save(path, overwrite=True)
        with h5py.File(path, "r+") as file:
            file[name][..., 2, 3] = np.nan
        with pytest.raises(ValueError, match="damaged"):
            Result.load(path)


def test_a_result_is_saved_slab_by_slab(tmp_path, monkeypatch):
    whole = polychromatic(np.linspace(0, 1, 60).reshape(GRID.shape))
    whole.save(tmp_path / "whole.h5")
    monkeypatch.setattr("tomo_polysplat.result.data._AT_ONCE", 20)
    parts = polychromatic(whole.material)
    assert [values.shape for _, values in parts.slabs()] == [(1, 4, 5)] * 3
    parts.save(tmp_path / "parts.h5")
    assert "volume" not in parts.__dict__, "it was never made as a whole"
    volumes = [h5py.File(tmp_path / f"{name}.h5")["exchange/data"][()] for name in ("whole", "parts")]
    np.testing.assert_allclose(volumes[1], volumes[0], rtol=1e-6)


def test_a_monochromatic_result_comes_back(tmp_path):
    result = Result(np.random.default_rng(0).random((1, *GRID.shape)), GRID, unit="pixel")
    result.save(tmp_path / "mono.h5")
    back = Result.load(tmp_path / "mono.h5")
    assert (
        back.materials is None and back.spectrum is None and back.energy_kev is None and back.unit == "pixel"
    )
    np.testing.assert_array_equal(back.volume, result.volume)


def test_the_file_is_data_exchange_with_where_and_what(tmp_path):
    result = polychromatic(np.linspace(0, 1, 60).reshape(GRID.shape))
    result.save(tmp_path / "result.h5")
    with h5py.File(tmp_path / "result.h5") as file:
        data = file["exchange/data"]
        np.testing.assert_array_equal(data[()], result.volume)
        assert (
            data.attrs["unit"] == "1/cm"
            and data.attrs["energy_kev"] == 55.0
            and data.attrs["axes"] == "z:y:x"
        )
        np.testing.assert_allclose(data.attrs["voxel_size"], [0.5, 1.0, 0.2])
        np.testing.assert_allclose(data.attrs["origin"], [-0.75, -1.5, -0.2])
        assert file["implements"][()] == b"exchange:polysplat"


def test_an_existing_file_is_kept_unless_told(tmp_path):
    path, other = tmp_path / "result.h5", tmp_path / "result.npy"
    for there in (path, other):
        there.write_text("mine")
        with pytest.raises(FileExistsError, match="overwrite=True"):
            polychromatic().save(there)
        assert there.read_text() == "mine"
    polychromatic().save(path, overwrite=True)
    assert Result.load(path).seconds == 1.25
    with pytest.raises(FileNotFoundError, match="existing folder"):
        polychromatic().save(tmp_path / "nowhere" / "result.h5")


def test_a_full_disk_is_noticed_before_writing(tmp_path, monkeypatch):
    monkeypatch.setattr(
        "tomo_polysplat.files.shutil.disk_usage", lambda _: type("Usage", (), {"free": 100})()
    )
    with pytest.raises(OSError, match="free disk space"):
        polychromatic().save(tmp_path / "result.h5")
    assert not list(tmp_path.iterdir())


def test_broken_files_are_refused(tmp_path):
    path = tmp_path / "result.h5"
    polychromatic().save(path)
    data = path.read_bytes()
    for share in (0.02, 0.5, 0.97):
        path.write_bytes(data[: int(share * len(data))])
        with pytest.raises(ValueError, match="readable HDF5"):
            Result.load(path)
    with h5py.File(path, "w") as file:
        file["exchange/data"] = np.zeros(3)
    with pytest.raises(ValueError, match=r"Result\.save"):
        Result.load(path)


def test_tiff_slices(tmp_path):
    import tifffile

    result = polychromatic(np.linspace(0, 1, 60).reshape(GRID.shape))
    folder = tmp_path / "stack"
    result.save_tiff(folder)
    files = sorted(folder.iterdir())
    assert [file.name for file in files] == ["slice_0000.tif", "slice_0001.tif", "slice_0002.tif"]
    np.testing.assert_array_equal(np.stack([tifffile.imread(file) for file in files]), result.volume)
    about = json.loads(tifffile.TiffFile(files[0]).imagej_metadata["Info"])
    assert about["unit"] == "1/cm" and about["energy_kev"] == 55.0
    with pytest.raises(FileExistsError):
        result.save_tiff(folder)
    lower = polychromatic(basis=result.basis[:, :1], grid=VolumeGrid((1, 4, 5), (-1, -1, -1), (1, 1, 1)))
    lower.save_tiff(folder, overwrite=True)
    assert [file.name for file in folder.iterdir()] == ["slice_0000.tif"], "slices of the old stack are left"


def test_npy(tmp_path):
    polychromatic().save(tmp_path / "volume.npy")
    np.testing.assert_array_equal(np.load(tmp_path / "volume.npy"), polychromatic().volume)


def test_a_result_is_not_taken_for_a_scan(tmp_path):
    polychromatic().save(tmp_path / "volume.h5")
    with pytest.raises(ValueError, match=r"expected a scan, got the result.*Result\.load"):
        load_scan(tmp_path / "volume.h5")


def test_what_is_done_to_a_volume_does_not_change_what_is_saved(tmp_path):
    attenuation = np.random.default_rng(2).random((1, *GRID.shape)).astype(np.float32)
    alone = Result(attenuation.copy(), GRID, energy_kev=60.0)
    for result in (alone, polychromatic()):
        before, kept = result.basis.copy(), result.attenuation(result.energy_kev).copy()
        result.attenuation(result.energy_kev)[:] = 7
        np.testing.assert_array_equal(result.volume, kept)
        result.volume[:] *= 2
        np.testing.assert_array_equal(result.basis, before)


def test_results_are_compared_as_objects():
    one = polychromatic()
    assert one == one and one != polychromatic()


def test_another_energy_makes_another_volume(tmp_path):
    """Also in a file, where the number beside the volume has to be that of its energy."""
    result = polychromatic()
    before = result.volume.copy()
    result.energy_kev = 80.0
    expected = result.attenuation(80.0)
    np.testing.assert_array_equal(result.volume, expected)
    assert np.abs(before - expected).max() > 0.01 * before.max()
    result.save(tmp_path / "other.h5")
    np.testing.assert_array_equal(Result.load(tmp_path / "other.h5").volume, expected)

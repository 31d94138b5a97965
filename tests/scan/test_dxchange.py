"""Data Exchange through dxchange and without it: the same arrays. An unrelated package of the name is ignored."""

import importlib
import sys
from importlib.machinery import ModuleSpec
from types import ModuleType

import h5py
import numpy as np
import pytest

from tomo_polysplat.scan import dxchange_host
from tomo_polysplat.scan.io import load_scan, save_scan
from tomo_polysplat.simulate.scenes import simulate_scan


def module(**contents):
    made = ModuleType("dxchange")
    made.__spec__ = ModuleSpec("dxchange", None)
    vars(made).update(contents)
    return made


def standin(calls):
    """The functions of dxchange that are used, after their documentation."""

    def read_hdf5(fname, dataset, slc=None, dtype=None, shared=False):
        calls.append(dataset)
        with h5py.File(fname, "r") as file:
            return file[dataset][tuple(slice(*part) for part in slc or ())] if dataset in file else None

    def write_hdf5(data, fname="data.h5", gname="exchange", dname="data", dtype=None, overwrite=False):
        calls.append(fname)
        assert isinstance(fname, str) and fname.endswith(".h5") and overwrite
        with h5py.File(fname, "w") as file:
            file["implements"] = gname
            file[f"{gname}/{dname}"] = data

    return module(read_hdf5=read_hdf5, write_hdf5=write_hdf5, read_aps_tomoscan_hdf5=lambda *_: None)


@pytest.fixture(params=["standin", "real"])
def host(request, monkeypatch):
    """Calls of dxchange; None in their place means that there is nothing to count."""
    if request.param == "standin":
        calls = []
        monkeypatch.setitem(sys.modules, "dxchange", standin(calls))
        return calls
    if dxchange_host.real_dxchange() is None:
        pytest.skip("no dxchange (on Debian: python3-dxchange)")
    real, calls = importlib.import_module("dxchange"), []
    for name in ("read_hdf5", "write_hdf5"):
        function = getattr(real, name)
        monkeypatch.setattr(
            real, name, lambda *a, _f=function, _n=name, **k: (calls.append(_n), _f(*a, **k))[1]
        )
    return calls


@pytest.fixture
def raw(tmp_path):
    """A file of counts as a beamline writes it."""
    random = np.random.default_rng(0)
    path = tmp_path / "raw.h5"
    with h5py.File(path, "w") as file:
        file["exchange/data"] = random.integers(100, 4000, (9, 3, 20)).astype(np.uint16)
        file["exchange/data_white"] = np.full((4, 3, 20), 4000, np.uint16)
        file["exchange/data_dark"] = np.full((2, 3, 20), 90, np.uint16)
        file["exchange/theta"] = np.linspace(0, 180, 9)
    return path


def without_dxchange(monkeypatch, action):
    with monkeypatch.context() as patch:
        patch.setattr(dxchange_host, "real_dxchange", lambda: None)
        return action()


def test_reading_gives_the_same_arrays(host, raw, monkeypatch):
    monkeypatch.setattr("tomo_polysplat.scan.counts._BLOCK", 4 * 3 * 20)
    with_it = load_scan(raw)
    assert len(host) >= 3 + 3, "data in three blocks, white, dark and theta"
    number = len(host)
    alone = without_dxchange(monkeypatch, lambda: load_scan(raw))
    assert len(host) == number
    np.testing.assert_array_equal(with_it.projections, alone.projections)
    np.testing.assert_array_equal(with_it.proj_geom["Vectors"], alone.proj_geom["Vectors"])
    np.testing.assert_array_equal(with_it.valid is None, alone.valid is None)
    assert with_it.notes == alone.notes


@pytest.mark.parametrize("name", ["scan.h5", "scan.hdf5"])
def test_writing_gives_the_same_file(host, tmp_path, name, monkeypatch):
    scan = simulate_scan("pins", 10, 12)
    save_scan(scan, tmp_path / name)
    without_dxchange(monkeypatch, lambda: save_scan(scan, tmp_path / f"alone-{name}"))
    files = []
    for path in (tmp_path / name, tmp_path / f"alone-{name}"):
        with h5py.File(path) as file:
            content = {}
            file.visititems(
                lambda key, item, c=content: c.update({key: item[()] if hasattr(item, "shape") else 0})
            )
            files.append(content | {"attributes": dict(file["exchange/data"].attrs)})
    assert files[0].keys() == files[1].keys()
    for key in files[0]:
        np.testing.assert_array_equal(files[0][key], files[1][key], err_msg=key)
    np.testing.assert_array_equal(load_scan(tmp_path / name).projections, scan.projections)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([name, f"alone-{name}"])


def test_missing_angles_are_refused_and_not_made_up(host, raw):
    with h5py.File(raw, "r+") as file:
        del file["exchange/theta"]
    with pytest.raises(ValueError, match="theta= in degrees"):
        load_scan(raw)


@pytest.mark.parametrize("other", [module(), None], ids=["unrelated", "missing"])
def test_an_unrelated_or_missing_package_is_not_used(other, raw, monkeypatch):
    monkeypatch.setitem(sys.modules, "dxchange", other)
    assert dxchange_host.real_dxchange() is None
    assert load_scan(raw).views == 9


def test_a_dxchange_that_breaks_when_imported_is_not_used(raw, monkeypatch, tmp_path):
    (tmp_path / "dxchange.py").write_text("raise RuntimeError('numpy is too new')")
    monkeypatch.delitem(sys.modules, "dxchange", raising=False)
    monkeypatch.syspath_prepend(tmp_path)
    assert dxchange_host.real_dxchange() is None
    assert load_scan(raw).views == 9

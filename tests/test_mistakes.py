"""Typical mistakes: each is refused before the work, by its name, with what was expected and got and how to mend it."""

import shutil

import h5py
import numpy as np
import pytest
import tifffile

from tomo_polysplat.cli import main
from tomo_polysplat.plan.solver import Solver
from tomo_polysplat.simulate.folders.scene import marked_scan
from tomo_polysplat.simulate.folders.write import write_folder

# After `recon scan.h5 -o x.h5`: the options, and what must stand in the message.
OPTIONS = {
    "--kvp 90000 --filter none": "kvp: expected a finite number >= 20 and <= 450, got 90000.0; the tables of anode W",
    "--kvp 0.09": ">= 20 and <= 450, got 0.09",
    "--kvp 90kV": "argument --kvp: expected a number without a unit, such as 2.5, got '90kV'",
    "--filter Al:0.1": "--filter: expected --kvp with it, got no --kvp",
    "--kvp 90 --filter Al": "expected a material and its thickness, got 'Al'; write a material",
    "--kvp 90 --filter 1mm": "expected a material and its thickness, got '1mm'; write a material",
    "--kvp 90 --filter Alu:0.1": "--filter: expected a known material, got 'Alu:0.1' (material",
    "--kvp 90 --filter Al=0.1": "got 'Al=0.1'; write a material and its thickness with a unit",
    "--kvp 90 --detector film": "--detector: expected counting, integrating, or one of csi, gos",
    "--kvp 90 --detector csi:0.6": "expected a thickness with its unit, got 'csi:0.6'; write csi:0.6mm",
    "--kvp 90 --anode Fe": "anode: expected one of W, Mo, Rh, Ag, Cu, Au, got 'Fe'; else pass Spectrum",
    "--kvp 120 --anode Mo": "<= 50, got 120.0; the tables of anode Mo cover 20-50 kVp",
    "--spectrum words.txt": "--spectrum: expected two numbers a line, got '20 one' in line 2 of words.txt",
    "--spectrum three.txt": "--spectrum: expected two numbers a line, got '20 1 1' in line 1 of three.txt",
    "--spectrum none.txt": "--spectrum: expected an existing file, got none.txt",
    "--spectrum three.txt --kvp 90": "--spectrum: expected none of --kvp",
    "--energy 60000": "--energy: expected keV between 0.1 and 800, got 60000",
    "--energy 0.06": "--energy: expected keV between 0.1 and 800, got 0.06",
    "--mono --energy 60": "--energy: expected a spectrum, from the file or from --kvp, got none",
    "--unit inch": "unit: expected one of m, cm, mm, um, pixel, got 'inch'",
    "--unit mm": "unit: expected 'cm', which the file states, got 'mm'; leave unit out",
    "--centre 5": "centre: expected None, got a value; the geometry is known already",
    "--pixel-size 0.1": "pixel_size: expected None, got a value; the geometry is known already",
    "--saturation 60000": "saturation: expected counts in the file, got attenuation, which has none",
    "--water-correction 1 2": "water_correction: expected c_0 = 0 and c_1 > 0, got c_0 = 1",
    "--quality high": "argument --quality: 'high': expected one of fast, balanced, best",
    "--time-budget -5": "time_budget: expected a finite number > 0, got -5.0",
    "--time-budget 5m": "argument --time-budget: expected a number without a unit, such as 2.5, got '5m'",
    "--materials water bone": "argument --materials: expected 3 arguments",
    "--materials water bon iron": "got 'bon'; did you mean bone or boron",
    "--calibrate scater": "calibrate: expected one of scatter, kvp, filter, got 'scater'; did you mean scatter?",
    "--calibrate kvp": "calibrate: expected a known density for 'kvp', got none; pass soft_density=",
    "--align w": "align: expected one of u, v, roll",
    "--align u --time-budget 9": "align: expected 'auto' or none beside a time_budget",
    "--soft-density 1050": "soft_density: expected calibrate beside it, got none; pass calibrate=True",
    "--set passes": "--set: expected NAME=VALUE, got 'passes'",
    "--set pases=3": "expected the name of a setting, got 'pases'; did you mean passes?",
    "--set passes=-3": "settings['passes']: expected a finite number > 0, got -3.0",
    "--device gpu": "device: expected auto, cpu, cuda or cuda:N, got 'gpu'",
    "--seed x": "argument --seed: expected a whole number, got 'x'",
    "--resume": "--resume: expected --checkpoint with it, got none",
    "--checkpoint scan.h5": "--checkpoint: expected a new file, got scan.h5, which exists; pass --resume",
    "--hu": "--output: expected a file of the volume alone for hu or bits, got .h5; choose one of",
    "--bits 8": "argument --bits: 8: expected one of 16, 32",
    "--time=3": "unknown: --time=3; did you mean --time-budget?",
}
# Whole commands.
COMMANDS = {
    "recon scan.h5": "required: -o/--output",
    "recon none.h5 -o x.h5": "path: expected an existing file, got none.h5",
    "recon empty -o x.h5": "got empty, which is none of these; name the folder or the file that the scanner wrote",
    "recon words.txt -o x.h5": "got words.txt, which is none of these; name the folder",
    "recon slice.tif -o x.h5": "expected the distances and the pixel of the scanner",
    "recon scan.h5 -o x.jpg": "--output: expected a name ending in .h5",
    "recon scan.h5 -o nowhere/x.h5": "--output: expected a file in an existing folder, got nowhere/x.h5; create",
    "recon scan.h5 -o scan.h5": "--output: expected a new file, got scan.h5, which exists; pass --overwrite",
    "recon scan.h5 -o scan.h5 --overwrite": "got one file twice: scan.h5 is scan too",
    "recon scan.h5 -o x.tif --hu --mono": "--hu: expected a spectrum and real lengths",
    "simulate tooth -o y.h5": "scene: expected one of pins, teeth, lung",
    "simulate teeth --size 0 -o y.h5": "size: expected a finite number >= 1, got 0.0",
    "simulate teeth --metal vibranium -o y.h5": "got 'vibranium'; did you mean",
    "simulate teeth -o y.tif": "--output: expected a name ending in .npz, .h5, .hdf5, got y.tif; a scan is no volume",
    "import tiffs -o z.tif": "--output: expected a name ending in .npz, .h5, .hdf5, got z.tif",
    "import tiffs -o z.h5 --rows 5-9": "--rows: expected A:B, got '5-9'; whole numbers with colons between them, such",
    "import tiffs -o z.h5 --rows 9:5": "rows: expected first < end, from 0 to 9, got 9, 5",
    "import tiffs -o z.h5 --binning 0": "binning: expected a positive whole number, got 0",
    "import tiffs -o z.h5 --views 0": "views: expected a positive whole number, got 0",
    "import tiffs -o z.h5 --flat nothing*.tif": "flats: expected files of pictures, got nothing*.tif",
    "import tiffs -o z.h5 --detector csi:0.6": "detector: expected a thickness with its unit",
    "import slice.tif -o z.h5 --sod 200 --sdd 500": "expected the distances and the pixel of the scanner",
    "import slice.tif -o z.h5 --sod 5 --sdd 2 --pixel 1": "source_detector: expected at least source_object, 5, got 2",
    "import slice.tif -o z.h5 --sod 2 --sdd 5 --pixel 1 --angles a.txt": "degrees: expected an existing file",
    "import rgb.tif -o z.h5 --sod 2 --sdd 5 --pixel 1": "got uint8 of shape (5, 6, 3) in rgb.tif; save them as grey",
    "import tiffs -o z.h5 --angles 6.2832": "arc: expected angles in degrees, got 0 to 4.71, which look like radians",
    "import tiffs -o z.h5 --angles two.txt": "got 2; name the angles of this scan, or say how far it turned: arc",
    "import tiffs -o z.h5 --flat dark_*.tif": "flats: expected an open beam that the object makes darker, got ",
    "import tiffs -o z.h5 --input transmission": "input: expected an open beam that the object makes darker, got ",
    "import tiffs -o z.h5 --input attenuation": "input: expected line integrals, such as 0 to 10, got ",
    "import nikon -o z.h5 --white 200": "white: expected an open beam that the object makes darker, got 201 times",
    "import torn -o z.h5": "expected a readable TIFF file, got torn/proj_0002.tif",
    "import sizes -o z.h5": "got uint16 of (5, 6) in sizes/proj_0002.tif; move it elsewhere",
    "import cropped -o z.h5": "flats: expected shape (9, 9) (rows, columns) of the projections, got (5, 6); take flats",
    "import dimmed -o z.h5": "flats: expected more light than darks has, 100 counts, got 9; are the two swapped",
    "import slip -o z.h5": "scan.toml: expected keys that are known, or none of their like, got 'sorce_object'; did",
    "import comma -o z.h5": "numbers have a decimal point (0.1)",
    "import eight -o z.h5": "flats: expected counts that pictures of uint8 can have, 255 at most, got 4",
    "import skyscan -o z.h5": "white: expected counts that pictures of uint8 can have, 255 at most, got 57000; were",
    "import skyscan/marker_0001.tif -o z.h5": "one of its pictures; name the folder: skyscan",
    "import jpeg -o z.h5": "which is none of these; its pictures are not read: save them as TIFFs of 16 bits",
    "import names.npz -o z.h5": "a stack of pictures is read too: call its arrays projections, flats, darks",
    "import archives -o z.h5": "call the arrays of the .npz file projections, flats, darks and degrees",
    "import hdf5 -o z.h5": "which is none of these; name the file of the scan: angles.h5, other.h5",
    "import hdf5/other.h5 -o z.h5": "no such dataset in hdf5/other.h5; NXtomo and CIL's NeXus are read too",
    "import hdf5/angles.h5 -o z.h5": "endpoint=False), or `tomo-polysplat import SCAN --angles 180`",
    "import hdf5/angles.h5 -o z.h5 --sod 2 --sdd 5 --white 9": "expected the distances and the pixel of the scanner",
    "view none.h5 --no-browser": "RESULT: expected an existing file, got none.h5",
    "view slice.tif --no-browser": "look at a TIFF in ImageJ",
    "view scan.h5 --port 99999": "--port: expected a number from 0 to 65535, got 99999",
    "check none.h5": "path: expected an existing file, got none.h5",
    "recn scan.h5": "'recn': did you mean recon?",
}
MISTAKES = {f"recon scan.h5 -o x.h5 {options}": message for options, message in OPTIONS.items()} | COMMANDS


def folders_gone_wrong(folder):
    """A stack of TIFFs with one thing wrong in each copy, and folders of files that are not read."""
    names = ("torn", "sizes", "cropped", "dimmed", "slip", "comma", "eight")
    torn, sizes, cropped, dimmed, slip, comma, eight = (folder / name for name in names)
    for copy in (torn, sizes, cropped, dimmed, slip, comma, eight):
        shutil.copytree(folder / "tiffs", copy)
    (torn / "proj_0002.tif").write_bytes((torn / "proj_0002.tif").read_bytes()[:200])
    tifffile.imwrite(sizes / "proj_0002.tif", np.zeros((5, 6), np.uint16))
    for flat in range(3):
        tifffile.imwrite(cropped / f"flat_{flat:04d}.tif", np.full((5, 6), 40000, np.uint16))
        tifffile.imwrite(dimmed / f"flat_{flat:04d}.tif", np.full((9, 9), 9, np.uint16))
    for name, old, new in ((slip, "source_object", "sorce_object"), (comma, "100.0", "100,0")):
        text = (name / "scan.toml").read_text()
        (name / "scan.toml").write_text(text.replace(old, new))
    write_folder("nikon", folder / "nikon", marked_scan(4, 9, 9))
    write_folder("skyscan", folder / "skyscan", marked_scan(4, 9, 9))
    for picture in [*eight.glob("proj*.tif"), *(folder / "skyscan").glob("*.tif")]:
        tifffile.imwrite(picture, (tifffile.imread(picture) >> 8).astype(np.uint8))
    for name in ("jpeg", "hdf5", "archives"):
        (folder / name).mkdir()
    (folder / "jpeg" / "proj_0.jpg").write_bytes(b"\xff\xd8")
    for name in ("names.npz", "archives/names.npz"):
        np.savez(folder / name, pictures=np.zeros((4, 5, 6)))
    with h5py.File(folder / "hdf5" / "angles.h5", "w") as file:
        file["exchange/data"] = np.full((4, 5, 6), 9, np.uint16)
    with h5py.File(folder / "hdf5" / "other.h5", "w") as file:
        file["entry/data"] = np.zeros((4, 5, 6))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("mistakes")
    assert main(["simulate", "pins", "--size", "8", "--views", "6", "-o", str(folder / "scan.h5")]) == 0
    write_folder("tiffs", folder / "tiffs", marked_scan(4, 9, 9))
    folders_gone_wrong(folder)
    (folder / "empty").mkdir()
    (folder / "words.txt").write_text("keV weight\n20 one\n")
    (folder / "two.txt").write_text("0\n90\n")
    (folder / "three.txt").write_text("20 1 1\n30 2 2\n")
    tifffile.imwrite(folder / "slice.tif", np.full((5, 6), 9, np.uint16))
    tifffile.imwrite(folder / "rgb.tif", np.zeros((5, 6, 3), np.uint8), photometric="rgb")
    return folder


@pytest.mark.parametrize("command", MISTAKES)
def test_a_mistake_is_told_before_the_work(command, folder, monkeypatch, capsys):
    def worked(*_, **__):
        raise AssertionError("the solver began")

    monkeypatch.setattr(Solver, "solve", worked)
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    try:
        status = main(command.split())
    except SystemExit as ended:
        status = ended.code
    said = capsys.readouterr().err
    assert status == 2 and MISTAKES[command] in said and "usage" not in said
    assert len(said.splitlines()) <= 4
    assert sorted(folder.rglob("*")) == before

"""The notebooks in examples/: they run at a small size, say what one learns, and carry no output."""

import json
from pathlib import Path

import matplotlib
import pytest

from tomo_polysplat.settings import PRESETS

FOLDER = Path(__file__).resolve().parents[1] / "examples"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
# Text that is replaced so that a test takes seconds; each must be there.
SMALL = {
    "01_quickstart": {"SIZE, VIEWS, QUALITY = 48, 120": "SIZE, VIEWS, QUALITY = 24, 48"},
    "02_tomopy_pipeline": {
        "COLUMNS, ROWS, VIEWS = 72, 12, 150": "COLUMNS, ROWS, VIEWS = 32, 4, 42",
        '"unit": "cm"}': '"unit": "cm", "quality": "fast"}',
        'unit="cm").volume': 'unit="cm", quality="fast").volume',
    },
    # Large enough for opposite rays to tell the axis, as in the notebook.
    "03_astra_cone_geometry": {"SIZE, VIEWS, QUALITY = 40, 120": "SIZE, VIEWS, QUALITY = 20, 40"},
    "04_spectrum_and_materials": {"SIZE, VIEWS, QUALITY = 40, 120": "SIZE, VIEWS, QUALITY = 24, 40"},
    "05_speed_against_error": {
        "SIZE, VIEWS, PASSES = 40, 120, (10, 40)": "SIZE, VIEWS, PASSES = 16, 24, (1, 2)"
    },
    "06_against_other_methods": {
        'SIZE, VIEWS, QUALITY = 40, 120, "balanced"': 'SIZE, VIEWS, QUALITY = 16, 32, "fast"'
    },
    "07_skyscan_to_imagej": {'VIEWS, QUALITY = 48, "balanced"': 'VIEWS, QUALITY = 24, "fast"'},
}


def cells(path, kind):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    return ["".join(cell["source"]) for cell in notebook["cells"] if cell["cell_type"] == kind]


def test_the_notebooks_are_numbered_and_complete():
    assert [path.stem for path in NOTEBOOKS] == sorted(SMALL)
    assert [path.name[:2] for path in NOTEBOOKS] == [f"{k + 1:02}" for k in range(len(SMALL))]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_outputs_are_stripped_and_the_opening_says_what_one_learns(path):
    notebook = json.loads(path.read_text(encoding="utf-8"))
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert all(not cell["outputs"] and cell["execution_count"] is None for cell in code)
    assert "You will learn" in cells(path, "markdown")[0]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_notebook_runs(path, tmp_path, monkeypatch):
    here, temporary = tmp_path / "here", tmp_path / "temporary"
    here.mkdir()
    temporary.mkdir()
    monkeypatch.chdir(here)
    # As in the five passes of "fast", no question is asked that needs more.
    for quality in ("fast", "balanced"):
        monkeypatch.setitem(PRESETS, quality, {"passes": 2.0, "views_per_step": 6})
    monkeypatch.setattr("tempfile.tempdir", str(temporary))
    source = "\n\n".join(cells(path, "code"))
    for old, new in SMALL[path.stem].items():
        assert old in source, f"{path.name} does not say {old!r}"
        source = source.replace(old, new)
    matplotlib.use("Agg")
    exec(compile(source, path.name, "exec"), {"__name__": "__main__"})
    matplotlib.pyplot.close("all")
    assert not list(here.iterdir()), "a notebook leaves files behind where it is run"

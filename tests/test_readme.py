"""README and the docs: every block of README runs as printed, in order, in a fresh folder; pages stay short."""

import importlib.util
import re
import shlex
from pathlib import Path

import pytest

from tomo_polysplat.cli import main
from tomo_polysplat.settings import PRESETS

SPECTRA_ARE_DOUBTED = True  # see tests/conftest.py

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCK = re.compile(r"^```(\w*) ?(\w*)\n(.*?)^```", re.S | re.M)
INSTALL, NEEDS_TOMOPY = "install", "tomopy"


def test_every_block_of_the_readme_runs_in_order(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    # As printed, in two passes over the views: as in the five of "fast", no question is asked that needs more.
    for quality in ("fast", "balanced"):
        monkeypatch.setitem(PRESETS, quality, {"passes": 2.0, "views_per_step": 8})
    names: dict = {}
    blocks = [block for block in BLOCK.findall(README) if block[1] != INSTALL]
    assert {language for language, _, _ in blocks} == {"sh", "python"}
    for language, mark, text in blocks:
        if mark == NEEDS_TOMOPY and importlib.util.find_spec("tomopy") is None:
            continue
        if language == "python":
            exec(compile(text, "README.md", "exec"), names)
            continue
        for line in text.splitlines():
            program, *arguments = shlex.split(line)
            assert program == "tomo-polysplat"
            assert main(arguments) == 0, line
    made = {path.name for path in tmp_path.iterdir()}
    assert made >= {"scan.h5", "volume.h5", "report.html", "result.h5", "result.html", "copy.h5"}
    assert names["volume"].shape == names["result"].volume.shape


def test_every_block_of_the_readme_runs_a_second_time():
    """What was written the first time is in the way of nothing."""
    lines = [line for _, _, text in BLOCK.findall(README) for line in text.splitlines()]
    writing = [line for line in lines if re.search(r" -o | demo|\.save\(|\.report\(|save_scan\(", line)]
    assert len(writing) == 6 and all("overwrite" in line for line in writing)


def test_the_readme_has_at_most_1500_words():
    assert len(re.sub(r"^```.*?^```", "", README, flags=re.S | re.M).split()) <= 1500


def test_the_changelog_of_what_was_never_released_has_at_most_40_lines():
    assert len((ROOT / "CHANGELOG.md").read_text(encoding="utf-8").splitlines()) <= 40


PAGES = [
    page
    for page in sorted((ROOT / "docs").rglob("*.md"))
    if not {"_build", "gallery", "generated"} & set(page.parts)
]


def test_no_line_of_the_docs_is_longer_than_200_characters():
    assert not [
        page.name
        for page in PAGES
        for line in page.read_text(encoding="utf-8").splitlines()
        if len(line) > 200
    ]


@pytest.mark.parametrize("page", [ROOT / "README.md", *PAGES], ids=lambda page: page.name)
def test_links_lead_to_files_that_exist(page):
    text = page.read_text(encoding="utf-8")
    targets = re.findall(r"\]\((?!https?:|#|mailto:)([^)#\s]+)", text)
    missing = [target for target in targets if not (page.parent / target).exists()]
    assert not missing

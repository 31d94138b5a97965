"""Figures and pages: what they show, to the same scale, and that they stand alone."""

import re
from html.parser import HTMLParser

import numpy as np
import pytest

from tomo_polysplat.plan.answer import Answer, Status
from tomo_polysplat.report.figures import comparison_figure, history_figure, slices_figure
from tomo_polysplat.report.slices import display_window, planes_through
from tomo_polysplat.report.table import as_text, is_best
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import VolumeGrid

TABLE = [
    {"name": "fdk", "seconds": 0.1, "psnr": 20.0, "psnr_all": 36.0, "ssim": 0.71, "rmse": 0.05},
    {"name": "polysplat", "seconds": 9.0, "psnr": 35.25, "psnr_all": 47.0, "ssim": 0.98, "rmse": 0.004},
]


def phantom(shape=(8, 9, 10)):
    truth = np.full(shape, 0.2)
    metal = np.zeros(shape, bool)
    metal[shape[0] // 2 : shape[0] // 2 + 1, 6, 3:5] = True
    truth[metal] = 9.0
    return truth, metal


def test_slices_go_through_the_metal():
    _, metal = phantom()
    assert [(plane.name, plane.index) for plane in planes_through(metal)] == [
        ("axial", 4),
        ("coronal", 6),
        ("sagittal", 3),
    ]
    assert [plane.index for plane in planes_through(np.zeros((8, 9, 10)))] == [4, 4, 5]
    assert len(planes_through(np.zeros((1, 9, 10)))) == 1


def test_metal_does_not_set_the_window():
    truth, metal = phantom()
    assert display_window(truth, metal) == (0.0, pytest.approx(0.22))
    truth[0, :3] = 2.0  # bone: shown saturated, so that soft tissue stays visible
    assert display_window(truth, metal) == (0.0, pytest.approx(0.6))
    assert display_window(np.zeros((3, 3, 3))) == (0.0, 1.0)


def test_every_panel_has_the_same_window():
    truth, metal = phantom()
    volumes = [("reconstruction", 3 * truth), ("truth", truth)]
    figure = slices_figure(volumes, "cm", 60.0, (0.0, 0.5), planes_through(metal))
    limits = {image.get_clim() for axis in figure.axes for image in axis.get_images()}
    assert limits == {(0.0, 0.5)}
    assert "60.0 keV (1/cm)" in figure.axes[-1].get_ylabel()


@pytest.mark.parametrize("shape", [(8, 9, 10), (1, 9, 10)])
def test_comparison_figure_is_written(tmp_path, shape):
    from matplotlib.image import imread

    truth, metal = phantom(shape)
    path = tmp_path / "demo.png"
    panels = [("fdk", truth * 0.8), ("polysplat", truth)]
    comparison_figure(path, panels, truth, metal, "cm", 42.0, TABLE)
    image = imread(path)
    assert image.shape[0] > 300 and image.shape[1] > 600 and image[..., :3].std() > 0.1
    with pytest.raises(FileExistsError):
        comparison_figure(path, panels, truth, metal, "cm", 42.0, TABLE)
    with pytest.raises(ValueError, match="panel 'fdk'"):
        comparison_figure(tmp_path / "x.png", [("fdk", truth[..., :4])], truth, metal, "cm", 42.0, TABLE)


def test_table_says_who_is_best():
    text = as_text(TABLE, "cm")
    assert "rms error (1/cm)" in text and re.search(
        r"tomo-polysplat +9\.0 +35\.2 +47\.0 +0\.980 +0\.0040", text
    )
    assert [is_best(TABLE, TABLE[1], column) for column in range(6)] == [False, False, True, True, True, True]
    assert not any(is_best(TABLE, TABLE[0], column) for column in range(6))
    assert "–" in as_text([{"name": "fdk", "seconds": 1.0}], "cm")


def test_history_shows_seconds_against_error():
    history = [{"seconds": 0.5 * k, "loss": 1 / (k + 1), "held_out": 2 / (k + 1)} for k in range(5)]
    lines = history_figure(history).axes[0].lines
    assert len(lines) == 2
    np.testing.assert_allclose(lines[1].get_xdata(), [0, 0.5, 1, 1.5, 2])
    np.testing.assert_allclose(lines[1].get_ydata(), [2, 1, 2 / 3, 0.5, 0.4])
    assert not history_figure([]).axes[0].lines


class Links(HTMLParser):
    """Collects what a page would load from elsewhere."""

    def __init__(self):
        super().__init__()
        self.tags, self.sources = [], []

    def handle_starttag(self, tag, attrs):
        self.tags.append(tag)
        self.sources += [value for name, value in attrs if name in ("src", "href")]


@pytest.mark.parametrize("flat", [False, True])
def test_the_page_stands_alone(tmp_path, flat):
    truth, metal = phantom((1, 9, 10) if flat else (8, 9, 10))
    result = Result(
        (truth + 0.01)[None],
        VolumeGrid(truth.shape, (-1, -1, -1), (1, 1, 1)),
        energy_kev=42.0,
        plan={"curves": Answer(1, "<no spectrum> & none wanted", Status.USUAL)},
        settings={"passes": 3.0},
        provenance={"scan": "wrist <left>", "device": "CPU"},
        history=[{"seconds": 1.0, "loss": 0.1, "held_out": 0.2}],
        flipped_2d=flat,
    )
    if flat:
        truth, metal = truth[0, ::-1], metal[0, ::-1]
    result.report(tmp_path / "r.html", truth=truth, metal_mask=metal)
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    links = Links()
    links.feed(page)
    assert links.tags.count("img") == (4 if flat else 5)
    assert all(source.startswith("data:image/") for source in links.sources)
    assert not {"link", "iframe", "object"} & set(links.tags)
    assert not re.findall(r"https?:|@import|fetch\(", page)
    assert "&lt;no spectrum&gt; &amp; none wanted" in page and "<no spectrum>" not in page
    assert "<title>wrist &lt;left&gt; – tomo-polysplat</title>" in page
    assert "26.0" in page, "20 log10(0.2 / 0.01) dB against the truth"
    assert flat or "slice 6 of 8, z = 0.625 cm" in page, "where it is in the volume, as the sentences have it"
    assert ">0.22 1/cm, the same in every picture" in page


def test_a_volume_of_metal_alone_has_a_page_without_the_comparison(tmp_path, caplog):
    truth, metal = phantom((3, 9, 10))
    result = Result(truth[None], VolumeGrid((3, 9, 10), [-1, -1, -1], [1, 1, 1]), "cm")
    result.report(tmp_path / "page.html", truth=truth, metal_mask=np.ones_like(metal))
    assert "not compared" in (tmp_path / "page.html").read_text() and "Not compared" in caplog.text

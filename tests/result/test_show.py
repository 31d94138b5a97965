"""Slices in a notebook: what is shown where, to one window, and that the sliders move it."""

import io
import sys

import numpy as np
import pytest

from tomo_polysplat.report.linked import LinkedSlices, bar_length
from tomo_polysplat.result.result import Result
from tomo_polysplat.scan.geometry import VolumeGrid

SHAPE = (5, 7, 9)
GRID = VolumeGrid(SHAPE, (-0.9, -0.7, -1.0), (0.9, 0.7, 1.0))


def ramp():
    return np.arange(np.prod(SHAPE), dtype=np.float32).reshape(SHAPE) / np.prod(SHAPE)


def shown(slices):
    return [[np.asarray(image.get_array()) for image in row] for row in slices._images]


def test_planes_go_through_the_point():
    volume = ramp()
    slices = LinkedSlices({"a": volume, "b": 2 * volume}, GRID.voxel_size, "cm", difference=True)
    assert slices.draw((1, 4, 6), (0.1, 0.5)).startswith(b"\x89PNG")
    for row, factor in zip(shown(slices), (1, 2, -1)):
        for image, expected in zip(row, (volume[1], volume[:, 4], volume[:, :, 6])):
            np.testing.assert_allclose(image, factor * expected, rtol=1e-6)
    limits = [[image.get_clim() for image in row] for row in slices._images]
    assert limits[0] == limits[1] == [(0.1, 0.5)] * 3 and limits[2] == [pytest.approx((-0.2, 0.2))] * 3


def test_pixels_have_the_voxels_proportions():
    """0.2 x 0.2 x 0.4 cm: a coronal pixel is twice as high as wide."""
    slices = LinkedSlices({"a": ramp()}, GRID.voxel_size, "cm")
    assert [axis.get_aspect() for axis in slices.figure.axes[:3]] == pytest.approx([1.0, 2.0, 2.0])


@pytest.mark.parametrize(("most", "length"), [(0.99, 0.5), (1.0, 1.0), (4.9, 2.0), (5.0, 5.0), (0.03, 0.02)])
def test_scale_bars_are_round(most, length):
    assert bar_length(most) == pytest.approx(length)


def test_sliders_move_the_slices():
    widgets = pytest.importorskip("ipywidgets")
    result = Result(ramp()[None], GRID)
    box = result.show({"other": ramp()[::-1]})
    *_, picture = box.children
    assert isinstance(picture, widgets.Image)
    before = picture.value
    z, y, x = box.children[0].children
    assert (z.max, y.max, x.max) == (4, 6, 8)
    z.value = (z.value + 1) % 5
    assert picture.value != before
    before = picture.value
    box.children[1].children[1].value = True
    from matplotlib.image import imread

    sizes = [imread(io.BytesIO(png)).shape[0] for png in (before, picture.value)]
    assert sizes[1] > 1.3 * sizes[0], "a row more for the difference"


def test_volumes_of_another_shape_are_refused():
    pytest.importorskip("ipywidgets")
    with pytest.raises(ValueError, match="other: expected shape"):
        Result(ramp()[None], GRID).show(np.zeros((5, 7, 8)))


def test_without_widgets_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    with pytest.raises(ImportError, match=r"tomo-polysplat\[notebook\]"):
        Result(ramp()[None], GRID).show()


@pytest.mark.parametrize("flat", [False, True])
def test_a_result_has_a_picture_in_a_notebook(flat):
    basis = ramp()[None, :1] if flat else ramp()[None]
    grid = VolumeGrid((1, 7, 9), (-1, -1, -1), (1, 1, 1)) if flat else GRID
    html = Result(basis, grid, provenance={"scan": "<b>"}, flipped_2d=flat)._repr_html_()
    assert 'src="data:image/png;base64,' in html and "&lt;b&gt;" in html and "9 x 7" in html

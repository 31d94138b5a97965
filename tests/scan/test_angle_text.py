"""Lists of angles as people and programs write them, and angles that are none in degrees."""

import time

import numpy as np
import pytest

from tomo_polysplat.scan.readers.angle_text import angles_in, require_degrees


@pytest.mark.parametrize(
    ("text", "angles"),
    [
        ("0\n7.5\n15\n", [0, 7.5, 15]),
        ("\r\nangle\r\n0,0\r\n7,5\r\n15,0\r\n", [0, 7.5, 15]),
        ("0,0\n1,7\n2,15\n", [0, 7, 15]),  # numbers of pictures, and their angles
        ("1, 0.0\n2, 7.5\n", [0, 7.5]),
        ("No;Angle\n1;0,25\n2;7,5\n", [0.25, 7.5]),
        ("a.tif\t0,25\nb.tif\t7,5  # noted later\n", [0.25, 7.5]),
        ("# degrees\n-90 \n-1e-3\n", [-90, -0.001]),
        ("1 0,5\n2 1\n", [0.5, 1]),
        ("0,000°\n7,500°\n", [0, 7.5]),
    ],
)
def test_lists(text, angles):
    np.testing.assert_allclose(angles_in(text), angles)


def test_words_among_numbers_are_refused():
    with pytest.raises(ValueError):
        angles_in("angle\n1\nbroken off\n3\n")


@pytest.mark.parametrize("turn", [np.pi, 2 * np.pi, -2 * np.pi])
@pytest.mark.parametrize("last", [True, False])
def test_even_radians_of_a_turn_are_refused(turn, last):
    with pytest.raises(ValueError, match="which look like radians; multiply them by 180 / pi"):
        require_degrees(np.linspace(0, turn, 181, endpoint=last))


@pytest.mark.parametrize(
    "angles", [np.linspace(0, 6, 61), np.arange(5.0), np.linspace(0, 360, 7), [0.0, 3.14]]
)
def test_degrees_of_a_small_arc_are_taken(angles):
    assert require_degrees(np.asarray(angles)) is not None


def test_a_long_line_of_separators_takes_no_time():
    begun = time.process_time()
    assert len(angles_in(";" * 200_000 + "1,5")) == 1
    assert time.process_time() - begun < 2

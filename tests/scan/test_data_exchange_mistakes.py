"""What is wrong with a Data Exchange file is said, not what comes of it."""

import h5py
import numpy as np
import pytest
from discs import CENTRE

from tomo_polysplat.scan.io import load_scan


def test_angles_that_look_like_radians_are_said_to(exchange):
    """Before the axis is looked for: to give one, as a search in vain advises, would not mend the angles."""
    path, _ = exchange(theta=np.linspace(0, np.pi, 91))
    with pytest.raises(ValueError, match=r"theta: expected at least half a turn.*radians.*units"):
        load_scan(path)
    with h5py.File(path, "a") as file:
        file["exchange/theta"].attrs["units"] = "radians"
    assert load_scan(path).notes["centre"] == pytest.approx(CENTRE, abs=0.15)


@pytest.mark.parametrize("what", ["swapped", "dark", "nan"])
def test_open_beam_images_without_light_are_named(exchange, what):
    path, _ = exchange()
    with h5py.File(path, "a") as file:
        images = file["exchange/data_white"][()], file["exchange/data_dark"][()]
        white, dark = images[::-1] if what == "swapped" else (0.0 * images[0], images[1])
        for name, image in (("data_white", white * (np.nan if what == "nan" else 1)), ("data_dark", dark)):
            del file[f"exchange/{name}"]
            file[f"exchange/{name}"] = image
    with pytest.raises(ValueError, match="data_white: expected more light than data_dark"):
        load_scan(path)


def test_angles_that_a_file_lacks_are_stated_as_those_of_pictures_are(exchange):
    """By an arc, which the command line has too; lengths are in mm there."""
    path, _ = exchange()
    expected = load_scan(path, theta=np.arange(91) * 180 / 91, pixel_size=0.5, unit="mm")
    with h5py.File(path, "a") as file:
        del file["exchange/theta"]
    scan = load_scan(path, scanner={"arc": 180, "pixel": 0.5})
    np.testing.assert_allclose(scan.proj_geom["Vectors"], expected.proj_geom["Vectors"])
    assert scan.unit == "mm"
    with pytest.raises(ValueError, match="source_object, source_detector: expected both distances"):
        load_scan(path, scanner={"arc": 180, "pixel": 0.5, "source_object": 10.0})
    with pytest.raises(ValueError, match=r"one angle for each of 91 pictures, got 2; name the angles"):
        load_scan(path, scanner={"degrees": [0, 90]})

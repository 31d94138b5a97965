"""MetaImage files: those that ITK itself writes, and broken ones."""

import numpy as np
import pytest
import SimpleITK

from tomo_polysplat.scan.readers.metaimage import MetaImageFrames

HEADER = "NDims = 3\nDimSize = 5 3 2\nElementType = MET_SHORT\nBinaryData = True\n"


@pytest.mark.parametrize("dtype", ["i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"])
@pytest.mark.parametrize(("ending", "packed"), [("mha", False), ("mha", True), ("mhd", False), ("mhd", True)])
def test_what_itk_writes(tmp_path, dtype, ending, packed):
    values = np.arange(2 * 3 * 5).reshape(2, 3, 5).astype(dtype)
    image = SimpleITK.GetImageFromArray(values)
    image.SetOrigin((-1.5, 2.25, 7.0))
    image.SetSpacing((0.5, 0.25, 3.0))
    path = tmp_path / f"stack.{ending}"
    SimpleITK.WriteImage(image, str(path), packed)
    frames = MetaImageFrames(path)
    assert frames.shape == values.shape and frames.dtype == values.dtype
    assert frames.origin == (-1.5, 2.25) and frames.spacing == (0.5, 0.25)
    np.testing.assert_array_equal(frames.read(1, slice(1, 3), slice(0, 4)), values[1, 1:3, :4])


def test_numbers_of_the_other_order_and_behind_a_header_of_their_own(tmp_path):
    values = np.arange(30, dtype=">i2").reshape(2, 3, 5)
    (tmp_path / "x.raw").write_bytes(b"seven b" + values.tobytes())
    for size in (7, -1):
        text = HEADER + f"BinaryDataByteOrderMSB = True\nHeaderSize = {size}\nElementDataFile = x.raw\n"
        (tmp_path / "x.mhd").write_text(text)
        frames = MetaImageFrames(tmp_path / "x.mhd")
        np.testing.assert_array_equal(frames.read(1, slice(0, 3), slice(0, 5)), values[1])


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("DimSize = 5 3 2", "DimSize = 5 3 200", "6000 bytes of numbers, got 60"),
        ("DimSize = 5 3 2", "DimSize = 5 3", "NDims whole numbers"),
        ("DimSize = 5 3 2", "DimSize = 5 3 1e9", "whole numbers as DimSize"),
        ("MET_SHORT", "MET_OTHER", "one of MetaIO's types"),
        ("BinaryData = True", "BinaryData = False", "binary numbers"),
        ("BinaryData = True", "BinaryData = True\nCompressedData = True", "can be unpacked"),
        ("BinaryData = True", "BinaryData = True\nElementNumberOfChannels = 3", "grey values"),
        ("LOCAL", "../x.raw", "of the folder of the header"),
        ("LOCAL", "/dev/zero", "of the folder of the header"),
        ("LOCAL", "pipe", "an existing file"),
        ("ElementDataFile", "Another", "header of a MetaImage"),
    ],
)
def test_broken_ones_are_refused(tmp_path, old, new, message):
    import os

    os.mkfifo(tmp_path / "pipe")
    text = (HEADER + "ElementDataFile = LOCAL\n").replace(old, new)
    (tmp_path / "x.mha").write_bytes(text.encode() + bytes(60))
    with pytest.raises(ValueError if new != "pipe" else FileNotFoundError, match=message):
        MetaImageFrames(tmp_path / "x.mha")

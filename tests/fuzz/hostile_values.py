"""Values that nobody should pass, and bytes that nobody should have written."""

import numpy as np
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

NUMBERS = st.one_of(
    st.sampled_from([0, -1, 1, 2.5, -0.0, 2**31, 2**63, 10**18, 10**400, 1e308, -1e308, 1e-320]),
    st.sampled_from([float("nan"), float("inf"), float("-inf"), True, 1j]),
    st.integers(-5, 300),
    st.floats(-1e4, 1e4),
)
ODD_TEXTS = ["", "cm", "W", "Al", "NaN", "\x00", "\ud800", "<b>", "$\\frac", "a" * 5000]
# By categories, and not by codec: which of a million characters a codec knows takes seconds to find out.
TEXTS = st.sampled_from(ODD_TEXTS) | st.text(st.characters(exclude_categories=["Cs"]))
DTYPES = ["f2", "f4", ">f8", "f8", "i1", "u2", ">i4", "i8", "u8", "?", "c8", "U3", "S2", "M8[s]", "m8[s]"]
ARRAYS = st.sampled_from(DTYPES).flatmap(
    lambda name: hnp.arrays(np.dtype(name), hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5))
)
OBJECTS = st.sampled_from(
    [
        np.array([{}], object),
        np.array(None),
        np.zeros(2, [("a", "f4"), ("b", "i2")]),
        np.zeros(2, "V4"),
        np.zeros(2, "U0"),
    ]
)
VALUES = st.one_of(
    NUMBERS,
    TEXTS,
    ARRAYS,
    OBJECTS,
    st.sampled_from([None, b"", [], {}, (), [[1, 2], [3]], object, {"Al": "x"}, [None], {1: 2}]),
    st.lists(NUMBERS, max_size=4),
)


@st.composite
def damaged(draw, content: bytes) -> bytes:
    """A file's contents: whole, cut short, with a few bytes changed, or with a part of it elsewhere."""
    kind = draw(st.sampled_from(["whole", "whole", "cut", "flip", "flip", "splice"]))
    place = st.integers(0, max(len(content) - 1, 0))
    if kind == "cut":
        return content[: draw(place)]
    changed = bytearray(content)
    if kind == "flip":
        # Half of the changes near the ends, where archives and HDF5 keep what describes the rest.
        ends = st.one_of(st.integers(0, 2000), st.integers(max(len(content) - 700, 0), len(content)))
        for position in draw(st.lists(st.one_of(place, ends), min_size=1, max_size=8)):
            if position < len(changed):
                changed[position] = draw(st.sampled_from([0, 1, 0x7F, 0x80, 0xFF]) | st.integers(0, 255))
    if kind == "splice":
        begin, end, target = draw(place), draw(place), draw(place)
        changed[target:target] = content[begin : min(end, begin + 4096)]
    return bytes(changed)


def mostly(usual, odd=VALUES):
    """Nine times in ten what is usual."""
    return st.integers(0, 9).flatmap(lambda number: odd if number == 9 else usual)


def replaced_values(entries: dict, values=VALUES, most: int = 2):
    """A mapping with all its names, a few of them with other values."""
    return st.dictionaries(st.sampled_from(sorted(entries)), values, max_size=most).map(
        lambda others: entries | others
    )


def replaced(entries: dict, values=VALUES, most: int = 2):
    """The same, and sometimes one of them left out."""
    names = st.just(None) | st.just(None) | st.sampled_from(sorted(entries))

    def without(case):
        return {name: value for name, value in case[0].items() if name != case[1]}

    return st.tuples(replaced_values(entries, values, most), names).map(without)

"""Checkpoints that somebody has tampered with, of one small run."""

import json
import logging
import tempfile
import warnings
from functools import cache
from pathlib import Path

import numpy as np
from hostile_files import npy_archive
from hostile_values import ARRAYS, OBJECTS, TEXTS, damaged, replaced
from hypothesis import strategies as st

import tomo_polysplat as tps

ODD = [
    *(
        None,
        True,
        False,
        0,
        -1,
        1,
        2,
        0.5,
        1e300,
        -1e300,
        1e-300,
        10**30,
        float("nan"),
        float("inf"),
        "",
        "nan",
    ),
    *("x" * 2000, "\x1b[31m", [], {}, [1], [[1.0, 2.0]], {"a": 1}, "blurred", "sharp", "fat"),
]


@cache
def scan():
    return tps.simulate_scan("pins", size=12, views=8, geometry="fan")


def resumed(path):
    """The run, from the file on if there is one."""
    given = scan()
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return tps.reconstruct(
                given,
                settings={"passes": 2.0, "views_per_step": 4},
                checkpoint=path,
                resume=True,
                calibrate=False,
            )
    finally:
        logging.disable(logging.NOTSET)


@cache
def sound() -> dict[str, np.ndarray]:
    """The arrays of a checkpoint."""
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "fit.npz"
        resumed(path)
        with np.load(path) as file:
            return dict(file)


def places(tree, path=()):
    """Where in a tree of JSON there is something."""
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list) else ()
    for key, value in inner:
        yield (*path, key)
        yield from places(value, (*path, key))


def changed(tree, path, value):
    """A copy of the tree with another value at a place, or none there."""
    tree = json.loads(json.dumps(tree))
    holder = tree
    for key in path[:-1]:
        holder = holder[key]
    if value is Ellipsis:
        del holder[path[-1]]
    else:
        holder[path[-1]] = value
    return tree


@st.composite
def one_number(draw, array):
    """The same array but for one of its numbers."""
    other = array.copy()
    odd = (
        [0, 1, -1, 127, 255]
        if array.dtype.kind in "iu"
        else [np.nan, np.inf, -np.inf, 1e38, -1e38, 0.0, 80.0]
    )
    if other.size:
        other.reshape(-1)[draw(st.integers(0, other.size - 1))] = draw(st.sampled_from(odd))
    return other


@st.composite
def checkpoints(draw) -> bytes:
    """A checkpoint with another word, number, array or byte in it."""
    arrays = dict(sound())
    kind = draw(st.sampled_from(["words", "words", "words", "number", "array", "bytes"]))
    if kind == "words":
        about = json.loads(bytes(arrays["about"]))
        for _ in range(draw(st.integers(1, 2))):
            # The digest and the options are looked at first, and seldom tell more.
            inside = [path for path in places(about) if path[0] in ("plan", "numbers")]
            path = draw(st.sampled_from(inside))
            about = changed(about, path, draw(st.sampled_from([*ODD, Ellipsis])))
        arrays["about"] = np.frombuffer(json.dumps(about).encode(), np.uint8)
    elif kind == "number":
        name = draw(st.sampled_from(sorted(set(arrays) - {"about"})))
        arrays[name] = draw(one_number(arrays[name]))
    elif kind == "array":
        arrays = draw(replaced(arrays, ARRAYS | OBJECTS | TEXTS.map(np.array)))
    content = npy_archive(arrays)
    return draw(damaged(content)) if kind == "bytes" else content

"""Arrays copied by all threads."""

import numpy as np

from tomo_polysplat.parallel import contiguous


def test_a_copy_in_another_order_and_type_is_numpys():
    array = np.random.default_rng(0).normal(size=(5, 7, 11))[:, ::-1]
    for view in (array.swapaxes(0, 1), array[0], array[:0]):
        copy = contiguous(view, np.float32)
        assert copy.flags.c_contiguous and copy.dtype == np.float32
        assert np.array_equal(copy, view.astype(np.float32))


def test_what_is_in_order_is_not_copied():
    array = np.zeros((3, 4), np.float32)
    assert contiguous(array, np.float32) is array


def test_what_the_type_cannot_hold_is_infinite_without_a_warning(recwarn):
    assert np.isinf(contiguous(np.full((4, 3), 1e300), np.float32)).all() and not recwarn

"""Runs that are killed on the way, and go on from their checkpoints."""

import numpy as np
import pytest


class Killed(Exception):
    """What no part of the package catches, as it catches no SIGKILL."""


def resumed_after(share, run, path):
    """What comes of a run that is killed after a share of it, and resumed; ``run`` takes options of `reconstruct`."""

    def die(state):
        if state.share >= share:
            raise Killed

    with pytest.raises(Killed):
        run(checkpoint=path, callbacks=[die])
    return run(checkpoint=path, resume=True)


def assert_same(resumed, whole, share):
    """The resumed run is the uninterrupted one, and says the same of itself."""
    assert np.array_equal(resumed.volume, whole.volume), share
    assert resumed.plan == whole.plan

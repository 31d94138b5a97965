"""Values that are not -log(I/I0) are refused by their kind; odd scans that are pass."""

import logging
from functools import partial

import numpy as np
import pytest
from small_scans import cone, fan, reconstruct

from tomo_polysplat.scan.line_integrals import require_line_integrals

NAME = "tomo_polysplat.scan"


def shadow(columns=61, views=23, rows=3, radius=0.7, bore=0.0, noise=0.01):
    """(views, rows, columns) of a cylinder of thickness 2 in the middle, with a hole; air beside it."""
    across = np.linspace(-1, 1, columns)
    chord = 2 * (
        np.sqrt(np.clip(radius**2 - across**2, 0, None)) - np.sqrt(np.clip(bore**2 - across**2, 0, None))
    )
    scatter = noise * np.random.default_rng(3).normal(size=(views, rows, columns))
    return (chord / radius * 1.5 + scatter).astype(np.float32)


WRONG = {
    "counts": (lambda p: 5e4 * np.exp(-p), "counts.*open-beam"),
    "dim counts": (lambda p: 200 * np.exp(-p), "counts.*open-beam"),
    "very dim counts": (lambda p: 40 * np.exp(-p), "counts.*open-beam"),
    "16 bits": (lambda p: (6e4 * np.exp(-p)).astype(np.uint16).astype(np.float32), "counts.*open-beam"),
    "transmissions": (lambda p: np.exp(-p), "transmissions.*-log of them"),
    "transmissions of a lamp that drifts": (
        lambda p: np.exp(-p) * np.linspace(0.97, 1.03, 23)[:, None, None],
        "transmissions",
    ),
    "other sign": (np.negative, "other sign"),
    "times a thousand": (lambda p: 1000 * p, "wrong scale.*factor"),
}


@pytest.mark.parametrize("case", WRONG)
@pytest.mark.parametrize("lost", [0.0, 0.3], ids=["all rays", "dead pixels"])
def test_values_of_another_kind_are_named_and_refused(case, lost):
    change, words = WRONG[case]
    values = change(shadow())
    values[np.random.default_rng(0).random(values.shape) < lost] = np.nan
    with pytest.raises(ValueError, match=rf"projections: expected -log\(I/I0\).*{words}"):
        require_line_integrals(values)


@pytest.mark.parametrize("make", [fan, partial(fan, False), cone], ids=["metal", "slice", "cone"])
@pytest.mark.parametrize("case", ["counts", "transmissions", "other sign", "times a thousand"])
def test_reconstruct_refuses_them_too(make, case):
    scan, (change, words) = make(), WRONG[case]
    with pytest.raises(ValueError, match=words):
        reconstruct(scan, change(scan.projections))


def spoilt(value, share=0.05):
    values = shadow()
    values[np.random.default_rng(1).random(values.shape) < share] = value
    return values


RIGHT = {
    "a scan": shadow(),
    "one view": shadow(views=1),
    "a slice": shadow(rows=1),
    "few columns": shadow(columns=5),
    "nothing": np.zeros((9, 3, 41)),
    "one value": np.full((9, 3, 41), 1.0),
    "noise": np.random.default_rng(0).normal(0, 0.3, (9, 3, 41)),
    "less than nothing": np.full((9, 3, 41), -0.02),
    "an even slab": 1.0 + 0.01 * np.random.default_rng(0).normal(size=(9, 3, 41)),
    "the flat field too dark": shadow() - 0.05,
    "pixels that glow": spoilt(-0.5),
    "pixels that saturate": spoilt(-0.3, 0.2),
    "a filler": spoilt(1e30),
    "a negative filler": spoilt(-1e6),
    "a filler of a file": spoilt(-999.0),
    "a filler of 16 bits": spoilt(65535.0, 0.6),
    "within the object": shadow()[..., 20:41],
    "within a tube": shadow(radius=1.0, bore=0.6)[..., 14:47],
    "a filler beside it": np.where(np.abs(np.linspace(-1, 1, 61)) < 0.8, shadow(), 65535.0),
    "lead in plastic": np.where(np.abs(np.linspace(-1, 1, 61)) < 0.2, 300 * shadow(), shadow()),
    "hardly anything": 0.001 * shadow(noise=0.5),
}  # fmt: skip


@pytest.mark.parametrize("case", RIGHT)
def test_odd_scans_are_scans(case, caplog):
    with caplog.at_level(logging.WARNING, NAME):
        require_line_integrals(np.asarray(RIGHT[case], np.float32))
    assert not caplog.text


@pytest.mark.parametrize("share", [0.3, 0.1])
def test_what_may_be_either_is_said(share, caplog):
    """A little more light behind the object than beside it: the sign, or a flat field of other light."""
    with caplog.at_level(logging.WARNING, NAME):
        require_line_integrals(-share * shadow())
    assert "do not look like -log" in caplog.text and "other sign" in caplog.text


def test_marked_rays_are_not_looked_at():
    values = shadow()
    wrong = np.zeros(values.shape, bool)
    wrong[:20] = True
    require_line_integrals(np.where(wrong, 5e4, values).astype(np.float32), wrong)
    with pytest.raises(ValueError, match="counts"):
        require_line_integrals(np.where(wrong, 5e4 * np.exp(-values), values).astype(np.float32))


@pytest.mark.parametrize("lost, told", [(0.9, True), (0.1, False)])
def test_a_mask_of_the_other_sense_is_said(lost, told, caplog):
    scan = fan(False)
    mask = np.random.default_rng(0).random(scan.projections.shape) > lost
    with caplog.at_level(logging.WARNING, NAME):
        reconstruct(scan, valid=mask)
    assert (f"{np.count_nonzero(~mask)} marked invalid" in caplog.text) == told
    assert ("must not be used" in caplog.text) == told

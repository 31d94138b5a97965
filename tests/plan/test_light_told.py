"""Some views are looked at first, and all of them where these show anything."""

import numpy as np
import pytest

from tomo_polysplat.fit.residual_sums import ResidualSums
from tomo_polysplat.nuisances.drift import Drift
from tomo_polysplat.nuisances.gains import Gains
from tomo_polysplat.nuisances.light_factor import WORTH
from tomo_polysplat.plan import light_told
from tomo_polysplat.settings import Settings

ROWS, COLUMNS, NOISE = 61, 83, 0.02


class _Scan:
    """What `ask_light` reads of a problem, and the sums of its rays."""

    def __init__(self, gain, views):
        rng = np.random.default_rng(3)
        self.left = rng.normal(0, NOISE, (views, ROWS, COLUMNS)) + rng.normal(0, gain, (ROWS, COLUMNS))
        self.held = rng.random(self.left.shape) < 0.05
        self.views, self.steps, self.asked = views, [], []
        self.geometry, self.taken, self.gains, self.drift = (
            self,
            self,
            np.zeros((ROWS, COLUMNS)),
            np.zeros(views),
        )

    def sums(self, some):
        some = np.arange(self.views) if some is None else some
        self.asked.append(len(some))
        left, held = self.left[some], self.held[some]
        block = np.arange(len(some)) * 8 // len(some)
        weight, total = np.zeros((2, 8, ROWS, COLUMNS))
        np.add.at(weight, block, ~held)
        np.add.at(total, block, np.where(held, 0.0, left))
        view, row, column = np.nonzero(held)
        by_view = np.zeros((2, len(some), 1))
        deviation = np.full(len(view), NOISE)
        parts = view, row * COLUMNS + column, left[held], deviation, some
        return ResidualSums(weight, total, by_view, by_view, *parts)


def asked(monkeypatch, gain, worth=WORTH, views=300, **options):
    scan = _Scan(gain, views)
    monkeypatch.setattr(light_told, "_axis_column", lambda problem: np.nan)
    told = light_told.ask_light(scan, scan.sums, Settings(**options), worth)
    return scan.asked, told["gains"]


# A third of them, 128 at most, and all where a third would be fewer than 32.
@pytest.mark.parametrize(("views", "first"), [(95, 95), (96, 32), (300, 100), (400, 128)])
def test_a_steady_scanner_is_looked_at_in_some_views_only(monkeypatch, views, first):
    looks, gains = asked(monkeypatch, 0.0, views=views)
    assert looks == [first] and not gains.kept and not gains.change.any()


# The fainter one is a twentieth of the noise of a ray: of all views it is worth 0.1 % of the misfit, of some it is not.
@pytest.mark.parametrize("gain", [0.05 * NOISE, 2 * NOISE])
def test_what_all_views_tell_is_not_missed_by_some(monkeypatch, gain):
    looks, gains = asked(monkeypatch, gain)
    assert looks == [100, 300]
    assert gain < NOISE or gains.kept


def test_what_is_worth_less_than_is_asked_for_is_told_by_some_views(monkeypatch):
    faint, strong = 0.05 * NOISE, 2 * NOISE
    assert asked(monkeypatch, faint, worth=0.05)[0] == [100]
    looks, gains = asked(monkeypatch, strong, worth=0.05)
    assert looks == [100, 300] and gains.kept


def test_what_a_caller_asks_for_is_told_by_all_views(monkeypatch):
    assert asked(monkeypatch, 0.0, gains=True)[0] == [300]


def test_a_part_of_the_views_rules_out_only_what_all_would_not_confirm():
    # Gains of variance x in units of a ray's noise take x^2 / (x + 1 / n) of the misfit, as n views tell them.
    for x in np.geomspace(1e-5, 1e-1, 41):
        of_all, of_some = (x**2 / (x + 1 / n) for n in (1000, 100))
        if Gains.gate({"rms": 1.0, "better": of_all, "error": 0.0}).kept:
            assert not Gains.ruled_out({"better": of_some, "error": 0.0}, 0.1)
    assert Gains.ruled_out({"better": 9e-5, "error": 0.0}, 0.1)
    assert not Gains.ruled_out({"better": float("nan"), "error": float("nan")}, 0.1)


def test_what_changes_of_gains_is_followed_farther_than_it_is_seen(monkeypatch):
    scan = _Scan(2 * NOISE, 300)
    monkeypatch.setattr(light_told, "_axis_column", lambda problem: np.nan)
    parts = scan, scan.sums, Settings()
    whole = light_told.ask_light(*parts)["gains"].change
    scan.gains, scan.left = 0.5 * whole, scan.left - 0.5 * whole
    some = light_told.ask_gains_again(*parts)
    # Told of some views, and without the drift that only all of them tell.
    assert scan.asked[-1] == 128 and list(some) == ["gains"]
    times = float(np.vdot(some["gains"].change, whole) / np.vdot(whole, whole)) / 0.5
    assert 1.5 < times < 2


def test_going_farther_ends_where_the_rest_is():
    # A share r of what is left comes back each time, as the object follows: all are found, and the slow ones sooner.
    for r in (0.0, 0.5, 0.9, 0.99):
        plain = farther = 1.0
        for _ in range(10):
            plain -= (1 - r) * plain
            farther -= (1 + light_told._FURTHER) * (1 - r) * farther
        assert abs(farther) < 0.2 if r < 0.9 else farther < plain**1.6


@pytest.mark.parametrize(("seen", "told"), [(0.2, True), (0.9, False)])
def test_a_drift_that_no_rays_beside_the_object_tell_is_told_with_what_looks_alike(seen, told):
    """Of a body that the detector cuts off the part that is not seen changes from view to view, too."""
    views, depths = 53, 3
    rng = np.random.default_rng(8)
    drift = 0.03 * np.cos(2 * np.arange(views) * 2 * np.pi / views)
    count = np.full((2, views, depths), 40.0)
    count[:, int(seen * views) :, 0] = 0
    view = rng.integers(views, size=900)
    by_depth = count * (drift[:, None] + rng.normal(0, 1e-4, count.shape))
    residual = drift[view] + rng.normal(0, 1e-3, 900)
    sums = ResidualSums(
        *np.zeros((2, 8, 3, 5)), count, by_depth, view, view, residual, np.full(900, 1e-3), np.arange(views)
    )
    found = light_told.light_told(_Scan(0.0, views), sums, Settings(gains=False))["drift"]
    np.testing.assert_allclose(found.change, drift, atol=1e-3)
    words = {"drift": found.answer().value, "beside": found.answer().evidence["beside"]}
    assert found.kept and ("matter" in found.why) == told and ("matter" in Drift.told(words)) == told
    assert ("source whose" in Drift.told(words)) != told

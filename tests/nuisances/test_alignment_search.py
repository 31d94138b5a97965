"""The search of a scanner's moves, with a misfit in closed form in the place of fits."""

import numpy as np
import pytest

from tomo_polysplat.nuisances.alignment import Alignment
from tomo_polysplat.nuisances.alignment_search import levels, schedule, search, worth_it
from tomo_polysplat.scan.view_geometry import Geometry


def orbit():
    angle = 2 * np.pi * np.arange(12) / 12
    zero = np.zeros(12)
    ahead = np.stack([-np.sin(angle), np.cos(angle), zero], axis=1)
    u = 0.05 * np.stack([np.cos(angle), np.sin(angle), zero], axis=1)
    v = np.tile([0.0, 0.0, 0.05], (12, 1))
    return Geometry("cone", -6 * ahead, 4 * ahead - 31.5 * u - 31.5 * v, u, v, 64, 64)


def test_levels_go_from_coarse_to_fine():
    assert levels(60) == [4, 2, 1] and levels(192) == [8, 4, 2] and levels(2000) == [128, 64, 32, 16]
    assert levels(20) == [1]
    rates = [schedule(0, 4).rate(share, 4) for share in (0.0, 0.5, 1.0)]
    assert rates[0] == 1.0 and rates[2] == pytest.approx(0.1) and rates[1] == pytest.approx(np.sqrt(0.1))
    assert schedule(2, 1).rate(0.0, 1) < schedule(1, 2).rate(0.0, 2)


def test_rays_must_say_so_clearly():
    assert worth_it(1.0, 0.95) and not worth_it(1.0, 0.97) and not worth_it(1.0, float("nan"))


class Fits:
    """Misfits of an axis off by ``u`` and of views off by ``wobble`` pixels, seen by pixels that are joined."""

    def __init__(self, alignment, u, wobble, coarse_views=True):
        self.alignment, self.u, self.wobble, self.asked = alignment, u, wobble, []
        self.coarse_views = coarse_views

    def __call__(self, level, factor, moving):
        self.asked.append((factor, moving))
        values = self.alignment.values
        if "u" in moving:
            values["u"] += 0.8 * (self.u - values["u"])
        if "views" in moving:
            # Without anything to find, many free numbers fit the noise of the fitted rays.
            values["views"] += 0.01 if not self.wobble else 0.8 * self.wobble
        off = abs(self.u - float(values["u"])) + abs(self.wobble - float(values["views"].abs().max()))
        seen = off / factor if self.coarse_views or "views" not in moving or factor < 4 else 1.0
        return 1.0 + seen + (0.03 if "views" in moving and not self.wobble else 0.0)


def test_a_perfect_scan_is_left_alone():
    alignment = Alignment(orbit(), 0.5)
    whole = alignment.names[:-1]
    fits = Fits(alignment, 0.0, 0.0)
    record = search(alignment, fits, [4, 2])
    assert record["confirmed"] == []
    assert not any(value.any() for value in alignment.values.values())
    assert [moving for _, moving in fits.asked[:3]] == [(), whole, ("views",)] and not alignment.names
    # By joined pixels of 32 columns all would have shown: finer ones are not asked.
    more = search(Alignment(orbit(), 0.5), Fits(alignment, 0.0, 0.0), [4, 2, 1])
    assert [entry["factor"] for entry in record["levels"]] == [4, 2] == [e["factor"] for e in more["levels"]]


def test_what_is_confirmed_moves_on_and_is_not_asked_again():
    alignment = Alignment(orbit(), 0.5)
    whole = alignment.names[:-1]
    fits = Fits(alignment, 2.0, 0.0)
    record = search(alignment, fits, [4, 2])
    assert record["confirmed"] == list(whole)
    # Once more from where it has come to, for a fair comparison with what follows.
    assert fits.asked[1:4] == [(4, whole), (4, whole), (4, (*whole, "views"))]
    assert fits.asked[4:] == [(2, whole), (2, (*whole, "views"))]
    assert float(alignment.values["u"]) == pytest.approx(2.0, abs=0.1)
    assert float(alignment.values["views"].abs().max()) == 0.0


def test_what_a_coarse_level_does_not_show_a_finer_one_may():
    alignment = Alignment(orbit(), 0.5)
    record = search(alignment, Fits(alignment, 0.0, 0.5, coarse_views=False), [4, 2])
    assert record["confirmed"] == ["views"] == list(alignment.names)
    assert record["levels"][0]["views"] > record["levels"][0]["without"]


def test_only_what_was_asked_for_is_searched():
    alignment = Alignment(orbit(), 0.5, names=("u",))
    alignment.values["views"] = Alignment(orbit(), 0.5).values["views"]
    fits = Fits(alignment, 1.0, 0.0)
    assert search(alignment, fits, [1])["confirmed"] == ["u"]
    assert [moving for _, moving in fits.asked] == [(), ("u",)]

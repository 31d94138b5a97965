"""Moves out of sums whose true moves are known."""

import numpy as np

from tomo_polysplat.nuisances.move_estimate import shifts_of_views, whole_moves

VIEWS, PIXELS = 40, 300


def sums(rng, moves, noise, offset=0.0):
    """Normal equations of (views, n) moves, of random slopes and of a constant in each view."""
    slopes = rng.normal(size=(VIEWS, PIXELS, moves.shape[1]))
    slopes[..., 0] += 0.5
    left = np.einsum("vpn,vn->vp", slopes, moves) + rng.normal(0, noise, (VIEWS, PIXELS)) + offset
    slopes = np.concatenate([slopes, np.ones((VIEWS, PIXELS, 1))], axis=2)
    return np.einsum("vpi,vpj->vij", slopes, slopes), np.einsum("vpi,vp->vi", slopes, left)


def halves(rng, moves, noise):
    parts = [sums(rng, moves, noise) for _ in range(2)]
    return tuple(np.stack(part) for part in zip(*parts))


def mean_of_all():
    return np.tile(np.eye(2), (VIEWS, 1)) / np.sqrt(VIEWS)


def test_what_all_views_share_is_found_with_its_error_whatever_their_light():
    far = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        light = np.repeat(rng.normal(0, 0.3, (VIEWS, 1)), PIXELS, axis=1)
        found = whole_moves(*sums(rng, np.tile([0.2, -1.0], (VIEWS, 1)), 1.0, light), (0, 1))
        far.append((found.value - [0.2, -1.0]) / found.error)
    assert 0.6 < np.sqrt(np.mean(np.square(far))) < 1.8


def test_slopes_that_tell_nothing_have_no_move():
    normal, told = sums(np.random.default_rng(0), np.zeros((VIEWS, 2)), 1.0)
    normal[:, 1], normal[:, :, 1] = normal[:, 0], normal[:, :, 0]
    normal[:, 1, 1] = normal[:, 0, 0]
    found = whole_moves(normal, told, (0, 1))
    assert not found.value.any() and np.isinf(found.error).all()
    few = whole_moves(*(part[:3] for part in sums(np.random.default_rng(0), np.zeros((VIEWS, 2)), 1.0)), (0,))
    assert not few.value.any()


def test_nothing_is_found_where_nothing_is_asked():
    """As of a slice whose axis is known: there, single views alone are asked."""
    found = whole_moves(*sums(np.random.default_rng(0), np.zeros((VIEWS, 2)), 1.0), ())
    assert found.value.shape == found.error.shape == (0,)


def test_views_are_shifted_by_what_both_halves_tell():
    rng = np.random.default_rng(1)
    true = rng.normal(0, 0.4, (VIEWS, 2))
    true -= true.mean(axis=0)
    found = shifts_of_views(*halves(rng, true, 1.0), mean_of_all())
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.06
    assert abs(found.mean(axis=0)).max() < 1e-12


def test_a_half_that_sees_little_hides_no_shift():
    rng = np.random.default_rng(2)
    true = rng.normal(0, 0.4, (VIEWS, 2))
    true -= true.mean(axis=0)
    normal, told = halves(rng, true, 1.0)
    # A hundredth of the slopes, and as much noise.
    weak = sums(rng, 0.01 * true, 1.0)
    normal[0], told[0] = weak[0], weak[1]
    normal[0, :, :2], normal[0, :, :, :2], told[0, :, :2] = (
        0.01 * normal[0, :, :2],
        0.01 * normal[0, :, :, :2],
        0.01 * told[0, :, :2],
    )
    found = shifts_of_views(normal, told, mean_of_all())
    assert np.sqrt(np.mean((found - true) ** 2)) < 0.1


def test_views_that_see_little_are_shifted_by_little():
    """Their noise is a hundred times that of the others, and is not taken for a shift."""
    rng = np.random.default_rng(4)
    true = rng.normal(0, 0.1, (VIEWS, 2))
    true -= true.mean(axis=0)
    normal, told = halves(rng, true, 0.3)
    normal[:, ::5, :2, :2] *= 1e-4
    normal[:, ::5, :2, 2] *= 1e-2
    normal[:, ::5, 2, :2] *= 1e-2
    told[:, ::5, :2] = 1e-2 * rng.normal(0, np.sqrt(PIXELS), (2, VIEWS // 5, 2))
    found = shifts_of_views(normal, told, np.zeros((2 * VIEWS, 0)))
    others = np.arange(VIEWS) % 5 > 0
    assert np.sqrt(np.mean(found[~others] ** 2)) < 0.02
    assert np.sqrt(np.mean((found - true)[others] ** 2)) < 0.04


def test_noise_shifts_no_view():
    for seed in range(20):
        rng = np.random.default_rng(seed)
        assert not shifts_of_views(*halves(rng, np.zeros((VIEWS, 2)), 1.0), mean_of_all()).any()


def test_one_row_tells_no_shift_along_rows():
    rng = np.random.default_rng(3)
    true = np.column_stack([rng.normal(0, 0.4, VIEWS), np.zeros(VIEWS)])
    normal, told = halves(rng, true - true.mean(axis=0), 0.5)
    normal[..., 1, :], normal[..., 1], told[..., 1] = 0.0, 0.0, 0.0
    found = shifts_of_views(normal, told, mean_of_all())
    assert not found[:, 1].any() and np.std(found[:, 0]) > 0.3

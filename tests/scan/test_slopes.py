"""Derivatives by one number."""

import torch

from tomo_polysplat.scan.slopes import slope_at_zero


def test_a_slope_has_the_shape_of_what_it_is_of():
    powers = torch.arange(1.0, 7.0, dtype=torch.float64).reshape(2, 3)
    # d/dx (2 + x)^n at 0 is n 2^(n - 1).
    found = slope_at_zero(lambda step: (2 + step) ** powers)
    torch.testing.assert_close(found, powers * 2 ** (powers - 1), rtol=1e-14, atol=0)


def test_what_the_number_does_not_change_has_no_slope():
    held = torch.ones(2, 3, dtype=torch.float64)
    assert not slope_at_zero(lambda step: held).any()
    half = slope_at_zero(lambda step: torch.stack([held[0], 3 * step * held[1]]))
    assert half.tolist() == [[0.0] * 3, [3.0] * 3]

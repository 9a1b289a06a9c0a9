"""The choice without a branch: against the one with."""

import numpy as np

from components.environments.industrial.arithmetic import choice


def test_a_choice_keeps_exactly_where_the_sign_is_below_zero() -> None:
    below = np.nextafter(1.2, 0.0)
    values = np.array([0.0, below, 1.2, 5.0, np.inf, -np.inf])
    numbers, other, sign = np.arange(6.0), -np.arange(6.0) - 0.5, values - 1.2
    expected = np.where(values < 1.2, numbers, other)
    choose = choice(numbers, sign, other)
    choose()
    np.testing.assert_array_equal(numbers, expected)
    sign[:] = -values  # the buffers are read anew at every call
    expected = np.where(sign < 0.0, numbers, other)
    sign += 0.0  # a negative zero would count as below zero
    choose()
    np.testing.assert_array_equal(numbers, expected)

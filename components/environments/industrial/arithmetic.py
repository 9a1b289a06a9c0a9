"""A choice between two numbers per copy, without a branch, and numbers that cost no conversion.

Which side a copy is on changes at random, and a processor that guesses wrongly loses more time than
the few operations on bits that take its place here.
"""

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

__all__ = ["SIGN_BIT", "choice", "number"]

Array = NDArray[np.float64]

SIGN_BIT: Final = np.array(63)
"""`np.right_shift` by it makes -1, all bits, of the int64 view of a negative number, else 0."""


def number(value: float) -> Array:
    """A number for operations on arrays: a Python number is converted anew by each of them."""
    return np.array(value)


def choice(numbers: Array, sign: Array, other: Array) -> Callable[[], None]:
    """A function by which `numbers` stay where `sign` is below zero and become `other` elsewhere.

    All are buffers of one shape; the content of `sign` is lost. A difference `a - b` is below zero
    exactly where `a < b`.
    """
    bits, mask, others = (array.view(np.int64) for array in (numbers, sign, other))

    def choose() -> None:
        np.right_shift(mask, SIGN_BIT, mask)
        np.bitwise_xor(bits, others, bits)
        np.bitwise_and(bits, mask, bits)
        np.bitwise_xor(bits, others, bits)

    return choose

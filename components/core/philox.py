"""Philox4x64-10: random words as a pure function of a counter and a key.

Salmon, Moraes, Dror, Shaw, "Parallel Random Numbers: As Easy as 1, 2, 3" (2011). Ten rounds turn a
counter of four 64-bit words, under a key of two, into four random words. There are two ways to the
same words: NumPy's generator, which is the faster one on a CPU, and :func:`philox` here, whose
integer operations run on any device and inside CUDA graphs.

PyTorch has no unsigned 64-bit arithmetic. Sums and products of int64 tensors wrap around as
unsigned ones do, bit for bit; only shifts to the right need care, as they copy the sign.
"""

from collections.abc import Sequence
from typing import Final

import numpy as np
import torch
from torch import Tensor

__all__ = ["WORDS", "host_words", "key_words", "philox"]

WORDS: Final = 4
"""Random words of a counter."""

_ROUNDS: Final = 10
_MULTIPLIERS: Final = (0xD2E7470EE14C6C93, 0xCA5A826395121157)
_KEY_STEPS: Final = (0x9E3779B97F4A7C15, 0xBB67AE8584CAA73B)
_LOW: Final = 0xFFFFFFFF


def _signed(word: int) -> int:
    """The int64 of the same bits as an unsigned 64-bit word."""
    return word - (1 << 64) if word >> 63 else word


def key_words(key: int) -> tuple[int, int]:
    """A 128-bit stream key as two words, the lower one first, as int64 of the same bits."""
    return _signed(key & ((1 << 64) - 1)), _signed(key >> 64)


def host_words(key: int, first: int, count: int) -> Tensor:
    """The words of counters ``first`` and after it under a key, int64 ``[count, 4]`` on the CPU.

    NumPy adds one to its counter before every block, so the words of ``first`` are those that
    :func:`philox` gives for the counter ``first + 1``.
    """
    raw = np.random.Philox(key=key, counter=first).random_raw(WORDS * count)
    return torch.from_numpy(raw.view(np.int64)).view(count, WORDS)


def philox(counter: Sequence[Tensor], key: Sequence[Tensor]) -> Tensor:
    """Random words of counters.

    Args:
        counter: Four words, the lowest first, int64 tensors that broadcast against one another.
        key: Two words likewise.

    Returns:
        int64 ``[..., 4]``.
    """
    a, b, c, d = counter
    low_key, high_key = key
    for number in range(_ROUNDS):
        if number:
            low_key, high_key = low_key + _signed(_KEY_STEPS[0]), high_key + _signed(_KEY_STEPS[1])
        first_high, first_low = _wide_product(_MULTIPLIERS[0], a)
        second_high, second_low = _wide_product(_MULTIPLIERS[1], c)
        a, b, c, d = second_high ^ b ^ low_key, second_low, first_high ^ d ^ high_key, first_low
    return torch.stack(torch.broadcast_tensors(a, b, c, d), dim=-1)


def _wide_product(factor: int, word: Tensor) -> tuple[Tensor, Tensor]:
    """The upper and lower 64 bits of the 128-bit product of two unsigned words."""
    factor_low, factor_high = factor & _LOW, factor >> 32
    low, high = word & _LOW, (word >> 32) & _LOW
    # Of the four products of halves, each fits into 64 bits, and so do these sums.
    carry = high * factor_low + ((low * factor_low >> 32) & _LOW)
    middle = low * factor_high + (carry & _LOW)
    upper = high * factor_high + ((carry >> 32) & _LOW) + ((middle >> 32) & _LOW)
    return upper, word * _signed(factor)

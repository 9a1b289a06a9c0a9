"""Philox4x64-10 against the vectors that its authors publish, and against NumPy."""

import numpy as np
import pytest
import torch

from components.core.philox import host_words, key_words, philox

ALL = (1 << 64) - 1
# From the known-answer file of the authors' library Random123: counter, key, words.
VECTORS = [
    (
        (0, 0, 0, 0),
        (0, 0),
        (0x16554D9ECA36314C, 0xDB20FE9D672D0FDC, 0xD7E772CEE186176B, 0x7E68B68AEC7BA23B),
    ),
    (
        (ALL, ALL, ALL, ALL),
        (ALL, ALL),
        (0x87B092C3013FE90B, 0x438C3C67BE8D0224, 0x9CC7D7C69CD777B6, 0xA09CAEBF594F0BA0),
    ),
    (
        (0x243F6A8885A308D3, 0x13198A2E03707344, 0xA4093822299F31D0, 0x082EFA98EC4E6C89),
        (0x452821E638D01377, 0xBE5466CF34E90C6C),
        (0xA528F45403E61D95, 0x38C72DBD566E9788, 0xA5A1610E72FD18B5, 0x57BD43B5E52B7FE6),
    ),
]


def tensor(word: int) -> torch.Tensor:
    return torch.from_numpy(np.array(word, np.uint64).view(np.int64))


@pytest.mark.parametrize(("counter", "key", "words"), VECTORS)
def test_known_answers(
    counter: tuple[int, ...], key: tuple[int, ...], words: tuple[int, ...]
) -> None:
    found = philox([tensor(word) for word in counter], [tensor(word) for word in key])
    assert tuple(int(word) & ALL for word in found) == words


@pytest.mark.parametrize("key", [0, 1, (1 << 128) - 1, 340260282863687890496256865367631918760])
@pytest.mark.parametrize("first", [0, 5, (1 << 40) + 3])
def test_the_host_has_the_same_words(key: int, first: int) -> None:
    zero = torch.tensor(0)
    counters = torch.arange(first + 1, first + 9)  # NumPy adds one before it makes words
    found = philox((counters, zero, zero, zero), [torch.tensor(word) for word in key_words(key)])
    assert torch.equal(found, host_words(key, first, 8))

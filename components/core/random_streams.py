"""Random streams of lanes: every draw is a pure function of (lane key, name, step).

A lane's numbers depend only on its own name, typically (dataset, algorithm, seed). The
counter-based generator Philox gives that without carried state: a lane key and a name select the
stream, the step a place in it. Therefore

- the lanes of a stack do not influence one another,
- a resumed run continues with the numbers that an uninterrupted run would have drawn, and the only
  random state in a checkpoint is the step counter,
- the numbers do not depend on the device: the random words are equal, bit for bit.

On a GPU they are drawn where they are used, inside CUDA graphs; on a CPU for several steps at
once, by NumPy.
"""

import hashlib
import math
from collections.abc import Mapping, Sequence
from functools import cache

import numpy as np
import torch
from torch import Tensor

from components.core.draws import Draw
from components.core.philox import WORDS, host_words, key_words, philox

__all__ = ["BLOCK", "LaneStreams", "lane_generator", "lane_key", "spawn_generators"]

BLOCK = 10
"""Steps drawn at once where nothing else is asked for; their numbers stay in the cache of a CPU."""

_COUNTER_WORDS = 4  # Philox counts with 4 x 64 bits; the highest word numbers the blocks.


def lane_key(*names: object) -> int:
    """Digest names such as ``("mediocre-0.2", "lion", 3)`` into a 128-bit stream key."""
    text = "\x1f".join(str(name) for name in names)
    return int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "big")


def lane_generator(key: int, block: int = 0) -> np.random.Generator:
    """Open the stream ``key`` at the beginning of block ``block``."""
    counter = [0] * (_COUNTER_WORDS - 1) + [block]
    return np.random.Generator(np.random.Philox(key=key, counter=counter))


def spawn_generators(keys: Sequence[int], purpose: str) -> list[np.random.Generator]:
    """One generator per lane for a single use such as weight initialisation."""
    return [lane_generator(lane_key(key, purpose)) for key in keys]


class LaneStreams:
    """Per-step random tensors for all lanes, drawn for several steps at once.

    Args:
        keys: One stream key per lane, see :func:`lane_key`.
        draws: Named drawing rules.
        device: Device of the drawn tensors.
        block: Steps drawn at once; only time and memory depend on it.
    """

    def __init__(
        self,
        keys: Sequence[int],
        draws: Mapping[str, Draw],
        device: torch.device,
        block: int = BLOCK,
    ) -> None:
        self._draws = {name: draw.to(device) for name, draw in draws.items()}
        self._keys = {name: [lane_key(key, name) for key in keys] for name in draws}
        self._device = device
        self._block = block
        self._first, self._count = 0, 0  # steps whose numbers are at hand
        self._drawn: dict[str, Tensor] = {}
        self._counter = torch.zeros((), dtype=torch.int64, device=device)
        self._layout = cache(self._lay_out)

    def at(self, step: int) -> dict[str, Tensor]:
        """Random tensors ``[L, ...]`` of one step; any step may be asked for at any time."""
        if not self._first <= step < self._first + self._count:
            self._first = step - step % self._block
            if self._device.type == "cpu":
                self._keep(self._host_words(self._block))
            else:
                self.stage(self._first, self._block)
                self.draw(self._block)
        return {name: numbers[step - self._first] for name, numbers in self._drawn.items()}

    def stage(self, first: int, count: int) -> None:
        """Tell the next :meth:`draw` of ``count`` steps where they begin."""
        self._first, self._count = first, 0
        self._counter.fill_(first)
        self._layout(count)  # copied to the device before a graph is captured, not within

    def draw(self, count: int) -> None:
        """Draw the staged steps by operations of the device.

        A CUDA graph that has captured this draws on every replay the numbers of as many steps from
        the one that was staged before the replay.
        """
        self._keep(self._device_words(count))

    def _keep(self, words: Mapping[str, Tensor]) -> None:
        """Make numbers of words ``[T, L, words]``."""
        self._drawn = {name: self._draws[name](own) for name, own in words.items()}
        self._count = len(next(iter(words.values())))

    def _host_words(self, count: int) -> dict[str, Tensor]:
        """Words ``[T, L, words]`` of T steps by name, from NumPy."""
        drawn = {}
        for name, keys in self._keys.items():
            words = self._draws[name].words
            blocks = -(-words // WORDS)
            lanes = [host_words(key, self._first * blocks, count * blocks) for key in keys]
            by_step = torch.stack([own.view(count, -1) for own in lanes], dim=1)
            drawn[name] = by_step[..., :words].contiguous()
        return drawn

    def _device_words(self, count: int) -> dict[str, Tensor]:
        """The same words, all at once, from where the device's own counter stands."""
        offsets, blocks, low_key, high_key = self._layout(count)
        counter, zero = offsets + blocks * self._counter, torch.zeros_like(self._counter)
        words = philox((counter, zero, zero, zero), (low_key, high_key))
        drawn, begin = {}, 0
        for name, keys in self._keys.items():
            wanted = self._draws[name].words
            shape = count, len(keys), -(-wanted // WORDS)
            end = begin + math.prod(shape)
            drawn[name] = words[begin:end].view(*shape[:2], -1)[..., :wanted].contiguous()
            begin = end
        return drawn

    def _lay_out(self, count: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Counters of steps 0 to ``count``, counters a step, both words of keys: ``[n]`` each."""
        parts = []
        for name, keys in self._keys.items():
            blocks = -(-self._draws[name].words // WORDS)
            # NumPy adds one before it makes words.
            offsets = 1 + torch.arange(count * blocks).view(count, 1, blocks)
            low, high = torch.tensor([key_words(key) for key in keys]).T.unflatten(1, (-1, 1))
            shaped = torch.broadcast_tensors(offsets, torch.tensor(blocks), low, high)
            parts.append([t.flatten() for t in shaped])
        return tuple(torch.cat(own).to(self._device) for own in zip(*parts, strict=True))  # type: ignore[return-value]

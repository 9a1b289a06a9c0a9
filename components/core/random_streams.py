"""Random streams of lanes: every draw is a pure function of (lane key, purpose, block number).

A lane's numbers depend only on its own name, typically (dataset, algorithm, seed). NumPy's
counter-based Philox generator gives that without carried state: a lane key selects the stream, the
block number selects a place in it. Therefore

- the lanes of a stack do not influence one another,
- a resumed run continues with the numbers that an uninterrupted run would have drawn, and the only
  random state in a checkpoint is the step counter,
- the numbers do not depend on the device that uses them.

Numbers are drawn for whole blocks of steps, so that an update does not loop over lanes.
"""

import hashlib
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

__all__ = [
    "Draw",
    "LaneStreams",
    "lane_generator",
    "lane_key",
    "normal_draw",
    "spawn_generators",
]

Draw = Callable[[np.random.Generator, int, int], npt.NDArray[np.generic]]
"""``draw(generator, lane, steps)`` returns an array ``[steps, ...]`` for one lane."""

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


def normal_draw(*shape: int) -> Draw:
    """Drawing rule of standard normal numbers, float32 ``[steps, *shape]``."""
    return lambda g, lane, steps: g.standard_normal((steps, *shape), np.float32)


class LaneStreams:
    """Per-step random tensors for all lanes, drawn in blocks.

    Args:
        keys: One stream key per lane, see :func:`lane_key`.
        draws: Named drawing rules; each is called once per lane and block.
        device: Device of the drawn tensors.
        block: Steps drawn at once. Part of the stream's identity: changing it changes the numbers.
    """

    def __init__(
        self,
        keys: Sequence[int],
        draws: Mapping[str, Draw],
        device: torch.device,
        block: int = 50,
    ) -> None:
        self._keys = list(keys)
        self._draws = dict(draws)
        self._device = device
        self._block = block
        self._number = -1
        self._cache: dict[str, Tensor] = {}
        self._staged = range(0)
        self._stages: dict[int, dict[str, Tensor]] = {}

    def at(self, step: int) -> dict[str, Tensor]:
        """Random tensors ``[L, ...]`` of one step; any step may be asked for at any time."""
        if step in self._staged:
            stage, place = self._stages[len(self._staged)], step - self._staged.start
            return {name: tensor[place] for name, tensor in stage.items()}
        return self._drawn(step)

    def stage(self, first: int, count: int = 1) -> None:
        """Prepare steps ``first ... first + count - 1`` where CUDA graphs of ``count`` read.

        The graph itself begins with :meth:`draw`.
        """
        for place in range(count):
            fresh = self._drawn(first + place)
            if count not in self._stages:
                self._stages[count] = {
                    name: tensor.new_empty((count, *tensor.shape)) for name, tensor in fresh.items()
                }
            for name, tensor in fresh.items():
                self._stages[count][name][place].copy_(tensor)
        self._staged = range(first, first + count)

    def draw(self, count: int) -> None:
        """Draw the staged steps, in a graph or outside; here they were drawn when staged."""

    def _drawn(self, step: int) -> dict[str, Tensor]:
        number, offset = divmod(step, self._block)
        if number != self._number:
            self._fill(number)
        return {name: block[offset] for name, block in self._cache.items()}

    def _fill(self, number: int) -> None:
        drawn: dict[str, list[npt.NDArray[np.generic]]] = {name: [] for name in self._draws}
        for lane, key in enumerate(self._keys):
            for name, draw in self._draws.items():
                generator = lane_generator(lane_key(key, name), number)
                drawn[name].append(draw(generator, lane, self._block))
        self._cache = {
            name: torch.from_numpy(np.stack(arrays, axis=1)).to(self._device)
            for name, arrays in drawn.items()
        }
        self._number = number

"""The last L frames of N running copies, newest first, without moving them at every step.

Frames are written from the end of a buffer towards its beginning, so that the window
`[N, L, features]`, newest first, is always a view. L - 1 frames are moved back to the end only when
the beginning is reached.
"""

import numpy as np
from numpy.typing import NDArray

__all__ = ["HISTORY_LENGTH", "FrameHistory"]

HISTORY_LENGTH = 30
"""Frames in an observation of the Industrial Benchmark."""

_SPARE_STEPS = 64


class FrameHistory:
    """Window over the newest frames of N copies.

    A new episode's history is its first frame repeated.

    Args:
        first_frames: `[N, features]`.
        length: frames in the window, L.

    Raises:
        ValueError: a length below one.
    """

    def __init__(self, first_frames: NDArray[np.float64], length: int = HISTORY_LENGTH) -> None:
        if length < 1:
            raise ValueError(f"history length is {length}; give at least 1.")
        copies, features = first_frames.shape
        self.length = length
        self._buffer = np.empty((copies, length + _SPARE_STEPS, features))
        self._newest = _SPARE_STEPS
        self._buffer[:, self._newest :] = first_frames[:, None]

    @property
    def window(self) -> NDArray[np.float64]:
        """`[N, L, features]`, newest first: a view that the next `push` may change."""
        return self._buffer[:, self._newest : self._newest + self.length]

    def push(self, frames: NDArray[np.float64]) -> NDArray[np.float64]:
        """Put `[N, features]` in front and return the new window."""
        if self._newest == 0:
            self._buffer[:, _SPARE_STEPS + 1 :] = self._buffer[:, : self.length - 1].copy()
            self._newest = _SPARE_STEPS + 1
        self._newest -= 1
        self._buffer[:, self._newest] = frames
        return self.window

    def restart(self, copies: NDArray[np.bool_], first_frames: NDArray[np.float64]) -> None:
        """Begin new episodes in the masked copies.

        Args:
            copies: `[N]` mask of the copies.
            first_frames: `[copies.sum(), features]`.
        """
        self.window[copies] = first_frames[:, None]

"""The rolling window over the newest frames."""

import numpy as np
import pytest

from components.environments.frame_history import FrameHistory


@pytest.mark.parametrize("length", [1, 2, 30])
def test_window_holds_the_newest_frames_newest_first(length: int) -> None:
    rng = np.random.default_rng(0)
    frames = rng.random((200, 3, 2))
    history = FrameHistory(frames[0], length)
    for newest in range(200):  # more steps than the buffer's spare room
        if newest > 0:
            history.push(frames[newest])
        rows = np.maximum(newest - np.arange(length), 0)
        np.testing.assert_array_equal(history.window, frames[rows].swapaxes(0, 1))


def test_restart_fills_only_the_masked_copies() -> None:
    history = FrameHistory(np.zeros((2, 1)), 3)
    history.push(np.ones((2, 1)))
    history.restart(np.array([False, True]), np.array([[9.0]]))
    assert history.window[:, :, 0].tolist() == [[1.0, 0.0, 0.0], [9.0, 9.0, 9.0]]

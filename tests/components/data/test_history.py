"""Histories gathered from frames stored once, against a loop, in NumPy and in torch."""

import numpy as np

from components.data.history import gather_history, history_rows, newest_first

LENGTHS = (1, 5, 2)  # transitions of three episodes; frames are one more each
FRAMES = np.random.default_rng(0).random((sum(LENGTHS) + len(LENGTHS), 4)).astype(np.float32)
FIRST = np.array([0, 2, 2, 2, 2, 2, 8, 8])
NEWEST = np.array([0, 2, 3, 4, 5, 6, 8, 9])


def by_loop(length: int) -> np.ndarray:
    rows = []
    for newest, first in zip(NEWEST, FIRST, strict=True):
        frames = []
        row = newest
        for _ in range(length):
            frames.append(FRAMES[row])
            row = row - 1 if row > first else first
        rows.append(np.concatenate(frames))
    return np.stack(rows)


def test_rows_are_newest_first_and_stop_at_the_first_frame() -> None:
    rows = history_rows(np.array([5, 2]), np.array([2, 2]), 5)
    assert rows.tolist() == [[5, 4, 3, 2, 2], [2, 2, 2, 2, 2]]


def test_gathers_what_a_loop_gathers() -> None:
    for length in (1, 3, 30):
        expected = by_loop(length)
        gathered = gather_history(FRAMES, NEWEST, FIRST, length)
        np.testing.assert_array_equal(gathered, expected)
        assert gathered.dtype == np.float32


def test_batches_of_any_shape() -> None:
    newest = np.array([[2, 3], [4, 5], [6, 9]])
    first = np.array([[2, 2], [2, 2], [2, 8]])
    assert gather_history(FRAMES, newest, first, 3).shape == (3, 2, 12)


def test_newest_first_makes_every_history_one_run_of_rows() -> None:
    starts = np.array([0, 3, 4, 9])  # episodes of 4, 2 and 6 frames
    frames = np.arange(12, dtype=np.float32)[:, None]
    order, place = newest_first(starts, 4)
    assert order.tolist() == [3, 2, 1, 0, 0, 0, 0, 5, 4, 4, 4, 4, 11, 10, 9, 8, 7, 6, 6, 6, 6]
    first = np.repeat([0, 4, 6], [4, 2, 6])
    expected = gather_history(frames, np.arange(12), first, 4)
    laid_out = frames[order, 0]
    for row in range(12):
        assert laid_out[place[row] : place[row] + 4].tolist() == expected[row].tolist()

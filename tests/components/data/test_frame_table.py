"""Histories from frame tables against plain loops."""

import numpy as np
import torch

from components.data.frame_table import FrameTable, LogLayout
from tests.components.robot import make_robot_log
from tests.components.synthetic import CPU


def test_windows_are_rows_one_behind_the_other() -> None:
    rows = torch.arange(24.0).view(8, 3)
    newest = torch.tensor([[0, 5], [2, 4]])
    found = FrameTable(rows).windows(newest, 3)
    assert found.shape == (2, 2, 9)
    for place in np.ndindex(2, 2):
        first = int(newest[place])
        assert torch.equal(found[place], rows[first : first + 3].flatten())


def test_several_tables_share_the_order_of_logs_of_unequal_episodes() -> None:
    logs = [make_robot_log(), make_robot_log("other", seed=5, episodes=7)]
    layout = LogLayout(logs, 4, CPU)
    frames = [torch.from_numpy(log.frames.copy()) for log in logs]
    table, twice = layout.table(frames), layout.table([2.0 * f for f in frames])
    histories = table.windows(layout.newest, 4)
    assert torch.equal(twice.windows(layout.newest, 4), 2.0 * histories)
    expected = [
        [log.frames[max(newest - lag, first)] for lag in range(4)]
        for log in logs
        for newest, first in zip(log.frame_rows(), log.first_rows(), strict=True)
    ]
    np.testing.assert_array_equal(histories, np.array(expected).reshape(len(expected), -1))

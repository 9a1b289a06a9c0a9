"""Extend logs beyond terminal states, so that models learn that these are absorbing.

In evaluation terminal states are absorbing: the system stays in the state whatever the actions, and
all rewards are 0. A log ends with the state, so a model of the log would have to extrapolate. Here
the terminal frame is repeated, with reward 0.

The actions of the added transitions are those of the episode again, from the last one backwards.
Zero actions, which occur nowhere else in a log, would let a model recognise terminal states by the
action instead of the frame, and miss them when a policy keeps acting.
"""

from dataclasses import replace

import numpy as np

from components.data.dataset import OfflineDataset

__all__ = ["with_absorbing_states"]


def with_absorbing_states(dataset: OfflineDataset, steps: int) -> OfflineDataset:
    """The log with every terminated episode continued in its terminal state.

    Args:
        dataset: The log; without terminal states it is returned as it is. Episodes that end by
            time-out are not changed.
        steps: Transitions added after each terminal state.

    Returns:
        A log in memory whose added transitions are terminal, too.
    """
    starts, ends = dataset.episode_starts[:-1], dataset.episode_starts[1:]
    ended = np.flatnonzero(dataset.terminated[ends - 1])
    if not len(ended) or steps < 1:
        return dataset
    ends, lengths = ends[ended], (ends - starts)[ended]
    place = np.repeat(ends, steps)  # before which transitions are added
    again = (ends[:, None] - 1 - np.arange(steps) % lengths[:, None]).ravel()
    rows = np.insert(np.arange(dataset.transitions), place, again)
    added = np.insert(np.zeros(dataset.transitions, np.bool_), place, values=True)
    terminal = np.repeat(dataset.frame_rows()[ends - 1] + 1, steps)
    frames = np.insert(np.arange(len(dataset.frames)), terminal + 1, terminal)
    longer = np.zeros(dataset.episodes, np.int64)
    longer[ended] = steps
    card = replace(dataset.card, digest=f"{dataset.card.digest}+{steps}", transitions=len(rows))
    return replace(
        dataset,
        card=card,
        frames=dataset.frames[frames],
        actions=dataset.actions[rows],
        rewards=np.where(added, np.float32(0.0), dataset.rewards[rows]),
        terminated=dataset.terminated[rows] | added,
        truncated=dataset.truncated[rows] & ~added,
        episode_starts=dataset.episode_starts + np.concatenate([[0], np.cumsum(longer)]),
    )

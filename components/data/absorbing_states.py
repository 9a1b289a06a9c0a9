"""Logs that go on after a fall, from which models learn that nothing happens there any more.

Evaluation absorbs: after a true terminal a system stays where it is, whatever is done, and earns
nothing. A log ends there, so that a model of it would have to guess. Here the terminal frame is
repeated, with reward 0.

The actions beside it are the episode's own once more, from the last one back. Zeros in their place,
which are logged nowhere else, would let a model tell the end from the action instead of the state,
and then never find it where a policy keeps acting.
"""

from dataclasses import replace

import numpy as np

from components.data.dataset import OfflineDataset

__all__ = ["with_absorbing_states"]


def with_absorbing_states(dataset: OfflineDataset, steps: int) -> OfflineDataset:
    """The log with every truly terminated episode continued in its terminal state.

    Args:
        dataset: The log; without terminals it is returned as it is. Time-outs are left alone.
        steps: Absorbed transitions after each terminal.

    Returns:
        A log in memory whose added transitions are terminal as well.
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

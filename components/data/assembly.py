"""Make a dataset of logged arrays: compute the card's statistics of them, in one place."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset, array_digest
from components.data.returns import RETURN_STEPS, log_returns
from components.data.splits import split_episodes
from components.data.validity import check_arrays, check_card

__all__ = ["assemble", "divided", "part_of"]

_OF_ARRAYS: Final = (
    "trajectories",
    "steps",
    "transitions",
    "return_steps",
    "first_window_return_mean",
    "first_window_return_min",
    "first_window_return_max",
    "all_windows_return_mean",
    "digest",
)
"""The fields of a card that follow from the arrays."""


def assemble(
    arrays: Mapping[str, NDArray[Any]],
    *,
    discount: float,
    frame_features: tuple[str, ...],
    action_features: tuple[str, ...],
    **card_fields: Any,
) -> OfflineDataset:
    """Make a dataset with its card.

    Args:
        arrays: Those of :class:`OfflineDataset`, by name.
        discount: Gamma of the returns on the card.
        frame_features: Names of the columns of the frames.
        action_features: Names of the columns of the actions.
        card_fields: The fields of the card that do not follow from the arrays.

    Raises:
        ValueError: An array is missing, or a value cannot be, see :mod:`components.data.validity`;
            or no episode has a whole window of returns.
    """
    source = f"the log {card_fields.get('name', '')}".rstrip()
    check_arrays(arrays, frame_features, action_features, source)
    lengths, terminated = np.diff(arrays["episode_starts"]), arrays["terminated"]
    longest = int(lengths.max())
    # Rewards after a terminal state are 0, so windows that reach beyond one are complete.
    return_steps = RETURN_STEPS if terminated.any() else min(RETURN_STEPS, longest)
    returns = log_returns(
        arrays["rewards"], terminated, arrays["episode_starts"], discount, return_steps
    )
    card = DatasetCard(
        trajectories=len(lengths),
        steps=longest,
        transitions=len(terminated),
        discount=discount,
        return_steps=return_steps,
        first_window_return_mean=float(returns.first.mean()),
        first_window_return_min=float(returns.first.min()),
        first_window_return_max=float(returns.first.max()),
        all_windows_return_mean=float(returns.every.mean()),
        frame_features=frame_features,
        action_features=action_features,
        digest=array_digest(arrays),
        **card_fields,
    )
    check_card(card, source)
    return OfflineDataset(card=card, **arrays)


def part_of(dataset: OfflineDataset, episodes: range) -> OfflineDataset:
    """Some consecutive episodes of a log as a log of the same name, with statistics of its own.

    Args:
        dataset: The log.
        episodes: Numbers of the episodes, in steps of one.

    Raises:
        ValueError: There are none, or none of them has a whole window of returns.
    """
    if not episodes:
        raise ValueError(f"a part of {dataset.card.name} has no episode; give it one at least.")
    starts = dataset.episode_starts[episodes.start : episodes.stop + 1]
    first, last = int(starts[0]), int(starts[-1])
    rows = {"frames": slice(first + episodes.start, last + episodes.stop)}
    arrays = {
        name: np.array(array[rows.get(name, slice(first, last))])
        for name, array in dataset.arrays().items()
        if name != "episode_starts"
    }
    card = {f.name: getattr(dataset.card, f.name) for f in fields(DatasetCard)}
    kept = {name: value for name, value in card.items() if name not in _OF_ARRAYS}
    return assemble(arrays | {"episode_starts": np.array(starts - first)}, **kept)


def divided(dataset: OfflineDataset, held_out: float) -> tuple[OfflineDataset, OfflineDataset]:
    """A log in two parts: the first episodes to learn from, the last ones to judge by.

    Models are fitted to both, and hold out episodes themselves: with four or more, both have two.

    Args:
        dataset: of at least two episodes.
        held_out: share of the episodes in the second part.

    Raises:
        ValueError: a share outside (0, 1), or a dataset of a single episode.
    """
    split = split_episodes(dataset, held_out, least=2)
    return part_of(dataset, split.train), part_of(dataset, split.held_out)

"""The dynamics specification, what is known of a system without learning, and model frames.

A *model frame* has known features, which follow from the action exactly, and learned ones, which
a model predicts:

    known' = clip(keep * known + scale * action, low, high)      reward = sum of weights * learned

The dataset's card names both. The last known features have the names of the actions and follow
them; any before these, such as a setpoint, are constant. On the Industrial Benchmark the known
features are its steerings, which keep their values and are moved by the action. Of a robot only the
action itself is known (keep 0, scale 1), and all observed features and the reward are learned. The
model frame of a state is assembled by name from the log: the frame, the action before it and the
reward received with it.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset

__all__ = ["REWARD", "DynamicsSpecification", "model_frames"]

REWARD: Final = "reward"
"""Name of the learned feature that is the reward received with a frame."""


@dataclass(frozen=True)
class DynamicsSpecification:
    """What a dataset's card says about the dynamics of its system.

    Attributes:
        known: Names of the features that follow from the action.
        learned: Names of those that are predicted; both together are a model frame.
        keep: For each action, the factor of its feature's old value.
        scale: For each action, the factor of the action.
        low: Smallest value of a feature that follows an action.
        high: Largest value of it.
        reward: Weight of each learned feature in the reward.
        sources: Index of each feature in (frame, action before it, reward with it).
        observed: Index of the first feature that policies see (those of the log's frames), and of
            the first one after these.
    """

    known: tuple[str, ...]
    learned: tuple[str, ...]
    keep: tuple[float, ...]
    scale: tuple[float, ...]
    low: float
    high: float
    reward: tuple[float, ...]
    sources: tuple[int, ...]
    observed: tuple[int, int]

    @classmethod
    def of_card(cls, card: DatasetCard) -> "DynamicsSpecification":
        """Read the specification from a dataset's card.

        Raises:
            ValueError: If the card's specification lacks a part, contradicts itself, or names
                features that the dataset does not log.
        """
        try:
            section = card.dynamics["known"]
            known, learned = tuple(section["features"]), tuple(card.dynamics["learned"])
            keep, scale = (tuple(map(float, section[name])) for name in ("keep", "scale"))
            low, high = float(section["low"]), float(section["high"])
            weights = dict(card.dynamics["reward"])
        except KeyError as error:
            raise ValueError(
                f"The card of {card.name} lacks {error} in its dynamics specification (`machine` "
                "in card.json), which virtual trajectories need; write it there, or generate the "
                "dataset again."
            ) from error
        features, frame = (*known, *learned), card.frame_features
        logged = [*frame, *card.action_features, REWARD]
        first = features.index(frame[0]) if frame[0] in features else len(features)
        last = first + len(frame)
        if not set(features) <= set(logged) or features[first:last] != frame:
            raise ValueError(
                f"The dynamics specification of {card.name} needs frames of {features}, but "
                f"{card.name} logs {frame} and actions {card.action_features}."
            )
        actions = card.action_features
        if known[-len(actions) :] != actions or not len(keep) == len(scale) == len(actions):
            raise ValueError(
                f"On the card of {card.name} the known features {known} must end with the actions "
                f"{actions}, and keep and scale have a number for each of these."
            )
        if not set(weights) <= set(learned):
            raise ValueError(
                f"On the card of {card.name} the reward {weights} must be made of {learned}."
            )
        return cls(
            known=known,
            learned=learned,
            keep=keep,
            scale=scale,
            low=low,
            high=high,
            reward=tuple(float(weights.get(name, 0.0)) for name in learned),
            sources=tuple(logged.index(name) for name in features),
            observed=(first, last),
        )

    @property
    def features(self) -> tuple[str, ...]:
        """Names of a model frame's features, the known ones first."""
        return self.known + self.learned

    @property
    def hides(self) -> bool:
        """Whether policies see less than a model frame."""
        return self.observed != (0, len(self.features))

    @property
    def shown(self) -> tuple[bool, ...]:
        """Whether policies see each of the learned features."""
        first, last = self.observed
        return tuple(first <= n < last for n in range(len(self.known), len(self.features)))


def model_frames(dataset: OfflineDataset, dynamics: DynamicsSpecification) -> NDArray[np.float32]:
    """Model frames ``[N + E, M]`` of all states of a log.

    The action before a state and the reward received with it are 0 in the first frame of an
    episode, which has no transition before it.

    Args:
        dataset: The log; if its frames are model frames, they are returned as they are.
        dynamics: The specification on its card.
    """
    if not dynamics.hides:
        return dataset.frames
    acted = dataset.actions.shape[1]
    before = np.zeros((len(dataset.frames), acted + 1), np.float32)
    after = dataset.frame_rows() + 1
    before[after, :acted], before[after, acted] = dataset.actions, dataset.rewards
    frames: NDArray[np.float32] = np.concatenate([dataset.frames, before], axis=1)
    return frames[:, dynamics.sources]

"""What is known of a system without learning, and the frames by which models see it.

A *model frame* has known features, which follow from the action exactly, and learned ones, which
a model predicts:

    known' = clip(keep * known + scale * action, low, high)      reward = sum of weights * learned

The dataset's card names both. The last known features bear the actions' names and follow them; any
before these, such as a setpoint, stay what they are. The Industrial Benchmark shows its steerings,
which keep their values and are moved by the action. Of a robot nothing is known but the action
itself (keep 0, scale 1), and everything it shows is learned, its reward included. The model frame
of a state is put together by name from what the log holds: the frame, the action before it, the
reward with it.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from components.data.dataset import DatasetCard, OfflineDataset

__all__ = ["REWARD", "DynamicsSpecification", "model_frames"]

REWARD: Final = "reward"
"""Name of the learned feature that is the reward received with a frame."""


@dataclass(frozen=True)
class DynamicsSpecification:
    """What a dataset's card says about its system.

    Attributes:
        known: Names of the features that follow from the action.
        learned: Names of those that are predicted; both together are a model frame.
        keep: What remains of a known feature, for each action.
        scale: What a unit of the action adds to it.
        low: Smallest value of a feature that follows an action.
        high: Largest.
        reward: Weight of each learned feature in the reward.
        sources: Place of each feature in (frame, action before it, reward with it).
        observed: Where the features that policies see, those of the log's frames, begin among a
            model frame's, and where they end.
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
        """Read the rule off a dataset's card.

        Raises:
            ValueError: If the card does not tell how actions move the system, or tells it of
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
                f"The card of {card.name} lacks {error} in its machine section, which virtual "
                "trajectories need; write it there, or generate the dataset again."
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
        """Whether policies see less than model frames."""
        return self.observed != (0, len(self.features))

    @property
    def shown(self) -> tuple[bool, ...]:
        """Of each learned feature, whether policies see it."""
        first, last = self.observed
        return tuple(first <= n < last for n in range(len(self.known), len(self.features)))


def model_frames(dataset: OfflineDataset, rule: DynamicsSpecification) -> NDArray[np.float32]:
    """Model frames ``[N + E, M]`` of all states of a log.

    What only a transition can tell, the action before a state and the reward received with it, is
    0 in the first frame of an episode.

    Args:
        dataset: The log; where its frames are model frames, they are returned as they are.
        rule: Read off its card.
    """
    if not rule.hides:
        return dataset.frames
    acted = dataset.actions.shape[1]
    before = np.zeros((len(dataset.frames), acted + 1), np.float32)
    after = dataset.frame_rows() + 1
    before[after, :acted], before[after, acted] = dataset.actions, dataset.rewards
    frames: NDArray[np.float32] = np.concatenate([dataset.frames, before], axis=1)
    return frames[:, rule.sources]

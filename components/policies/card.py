"""The card of a policy artifact, ``policy.json``: what the policy is and how it acts."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

from components.core.cards import CardFormat
from components.policies.deployment import KINDS

__all__ = ["CARDS", "FORMAT", "PolicyCard"]

FORMAT: Final = "policy/2"
_STORED_NAMES: Final = MappingProxyType({"takes_proximity": "takes_lambda"})
"""Fields that have another name in `policy.json`."""


@dataclass(frozen=True, kw_only=True)
class PolicyCard:
    """What a policy artifact is.

    Attributes:
        algorithm: Name of the learner.
        dataset: Name of the dataset it learned from.
        features: Names of a frame's features, in order.
        history: Frames in an observation, newest first; before the start the first one repeats.
        actions: Width of the action, every entry in [-1, 1].
        takes_proximity: Whether the proximity parameter is an input.
        steps: Training step of every stored snapshot, one per lane.
        kind: How it acts, a name in :data:`~components.policies.deployment.KINDS`.
        candidates: N, actions drawn per state; 0 if the policy is deterministic.
        noise: Width of the normal noise from which a candidate is made.
        perturbation: Largest change BCQ's actor may make to a generated action.
        ended_at: Update by which a loss, a weight or an action in the log's states had become
            infinite or undefined and learning ended; the snapshots after it repeat the last finite
            one. None: training used the whole budget.
    """

    algorithm: str
    dataset: str
    features: tuple[str, ...]
    history: int
    actions: int
    takes_proximity: bool
    steps: tuple[int, ...]
    kind: str = "tanh"
    candidates: int = 0
    noise: int = 0
    perturbation: float = 0.0
    ended_at: int | None = None

    def __post_init__(self) -> None:
        """Reject an unknown kind of policy.

        Raises:
            ValueError: Naming the known kinds.
        """
        if self.kind not in KINDS:
            raise ValueError(f"it acts by {self.kind!r}, known are {', '.join(KINDS)}")

    @classmethod
    def load(cls, path: Path) -> "PolicyCard":
        """Read ``policy.json``.

        Raises:
            FileNotFoundError: If there is none.
            ValueError: If it is damaged or of another format.
        """
        return CARDS.read(path)

    def to_json(self) -> str:
        """The text of ``policy.json``."""
        values = {_STORED_NAMES.get(name, name): value for name, value in asdict(self).items()}
        return json.dumps({"format": FORMAT, **values}, indent=2, allow_nan=False) + "\n"


def _amend(values: dict[str, Any]) -> None:
    for name, stored in _STORED_NAMES.items():
        if stored in values:
            values[name] = values.pop(stored)


CARDS: Final = CardFormat(
    kind=PolicyCard,
    what="policy",
    remedy="train the policy again",
    version=("format", FORMAT),
    amend=_amend,
)
"""How the text is read, and refused."""

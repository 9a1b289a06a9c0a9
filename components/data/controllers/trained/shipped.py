"""Shipped experts: a deterministic policy in two small files, and a card of its returns.

A folder holds `policy.json` and `weights.safetensors`, which are an ordinary policy artifact, and
`expert.json`, the card. `python -m flows.train_experts` makes such folders; those that datasets are
generated with lie beside this module, one per robot.
"""

import hashlib
import json
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import numpy.typing as npt

from components.core.cards import CardFormat
from components.core.files import write_text
from components.core.version import code_version
from components.policies.policy import Policy

__all__ = ["SHIPPED", "Expert", "ExpertCard", "act_in_double"]

Array = npt.NDArray[np.float64]

SHIPPED: Final = Path(__file__).parent
"""Below it lies one folder per robot."""

_CARD: Final = "expert.json"
_WEIGHTS: Final = "weights.safetensors"
_REMEDY: Final = (
    "make it with `python -m flows.train_experts robots=[NAME] install=true`, or restore the "
    "shipped files"
)


@dataclass(frozen=True, kw_only=True)
class ExpertCard:
    """Origin and returns of an expert.

    Attributes:
        robot: Its short name, e.g. "swimmer".
        environment: Gymnasium id of the system it was trained and evaluated on.
        physics: Variant of the system, e.g. "v3".
        simulator: Name and version of the physics engine.
        seed: Seed of the chosen policy.
        candidates: By seed, as text, the highest mean return at an evaluation during training, as
            far as it is finite.
        step: Environment steps after which the chosen policy was kept.
        training: Settings of the training, by name.
        episodes: Whole episodes of its evaluation after training, without noise.
        return_mean: Mean of the undiscounted returns of these episodes.
        return_std: Standard deviation of these returns.
        return_steps: Steps of the discounted return.
        discount: Per step, of the discounted return.
        discounted_return_mean: Mean of their discounted returns over the first steps.
        refinement: Settings of the search after training, by name; None where there was none.
        refined_at: Its iteration after which the policy was kept.
        refined_from: Mean return before it, in the same episodes.
        digest: sha256 of the weights' file.
        code_version: Version of the package that trained it.
    """

    robot: str
    environment: str
    physics: str
    simulator: str
    seed: int
    candidates: dict[str, float]
    step: int
    training: dict[str, Any]
    episodes: int
    return_mean: float
    return_std: float
    return_steps: int
    discount: float
    discounted_return_mean: float
    refinement: dict[str, Any] | None = None
    refined_at: int | None = None
    refined_from: float | None = None
    digest: str = ""
    code_version: str = field(default_factory=code_version)


_CARDS: Final = CardFormat(kind=ExpertCard, what="expert", remedy=_REMEDY)


def act_in_double(policy: Policy, frames: Array) -> Array:
    """Actions ``[N, A]`` of a policy of one lane for frames ``[N, F]``.

    In double precision: the order of additions in a matrix product depends on the size of the
    batch, and logs and reports must not depend on it.
    """
    scaling = policy.frames
    x = (frames - scaling.mean.double().numpy()) / scaling.scale.double().numpy()
    *hidden, (weight, bias) = (
        (weight[0].double().numpy(), bias[0].double().numpy()) for weight, bias in policy.layers
    )
    for inner_weight, inner_bias in hidden:
        x = np.maximum(x @ inner_weight + inner_bias, 0.0)
    actions: Array = np.tanh(x @ weight + bias)
    return actions


@dataclass(frozen=True)
class Expert:
    """A policy and its card."""

    policy: Policy
    card: ExpertCard

    def act(self, frames: Array) -> Array:
        """Actions ``[N, A]`` for frames ``[N, F]``, without noise."""
        return act_in_double(self.policy, frames)

    def save(self, folder: Path) -> None:
        """Write the expert into an existing folder; the card appears last."""
        self.policy.save(folder)
        card = replace(self.card, digest=_digest(folder))
        text = json.dumps(asdict(card), indent=2, sort_keys=True, allow_nan=False) + "\n"
        write_text(folder / _CARD, text)

    @classmethod
    def load(cls, folder: Path) -> "Expert":
        """Read what :meth:`save` wrote.

        Raises:
            FileNotFoundError: A file is missing.
            ValueError: A file is damaged, or the weights are not those of the card.
        """
        card = _CARDS.read(folder / _CARD)
        try:
            policy = Policy.load(folder)
        except (ValueError, FileNotFoundError) as error:
            raise type(error)(f"{str(error).rstrip('.')}; {_REMEDY}.") from error
        if _digest(folder) != card.digest:
            raise ValueError(
                f"{folder / _WEIGHTS} does not have the digest on its card, so it was changed or "
                f"damaged; {_REMEDY}."
            )
        return cls(policy, card)


def _digest(folder: Path) -> str:
    return hashlib.sha256((folder / _WEIGHTS).read_bytes()).hexdigest()

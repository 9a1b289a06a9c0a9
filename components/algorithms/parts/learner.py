"""Inputs and interface of learners, and helpers that all of them use."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor, nn

from components.data.batches import Batch, LaneData
from components.data.dynamics import DynamicsSpecification
from components.policies.policy import Policy, PolicyCard
from components.training.cuda_graphs import BranchingLearner
from components.training.loop import adam

__all__ = [
    "LearnerInputs",
    "PolicyLearner",
    "Scalars",
    "adam_each",
    "bootstrapped",
    "descend",
    "gather_gradients",
    "needed",
    "saturation",
]

SATURATED = 0.99
M = TypeVar("M")


@dataclass(frozen=True)
class LearnerInputs:
    """Data, random streams and fitted models of L lanes.

    Attributes:
        data: The lanes' datasets on their device.
        keys: One random stream per lane, a digest of (dataset, algorithm, seed).
        models: Fitted models by name in :data:`components.models.MODELS`, one per lane each.
    """

    data: LaneData
    keys: Sequence[int]
    models: Mapping[str, Sequence[Any]] = field(default_factory=dict)

    def fitted(self, name: str, kind: type[M]) -> list[M]:
        """The lanes' models of a name, all of which have the given class.

        Raises:
            ValueError: If there are models of another class, or not one per lane.
        """
        found = [model for model in self.models.get(name, ()) if isinstance(model, kind)]
        if len(found) != self.data.lanes:
            raise ValueError(f"{self.data.lanes} lanes need as many {kind.__name__} as {name!r}.")
        return found

    @property
    def dynamics(self) -> DynamicsSpecification:
        """The dynamics specification on the datasets' cards, equal for all lanes.

        Raises:
            ValueError: If the lanes' specifications differ.
        """
        rules = {DynamicsSpecification.of_card(dataset.card) for dataset in self.data.datasets}
        if len(rules) != 1:
            raise ValueError("The datasets of one stack have different dynamics; train them apart.")
        return rules.pop()

    @property
    def mean_window_returns(self) -> list[float]:
        """Mean discounted 100-step return of each lane's log, over all window starts."""
        return [dataset.card.all_windows_return_mean for dataset in self.data.datasets]


class PolicyLearner(BranchingLearner, Protocol):
    """A stack of learners that can be deployed."""

    @property
    def pretraining(self) -> int:
        """Number of updates before the budget begins, during which no policy is kept."""

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the learners' current networks, equal to those of :meth:`policy`.

        Args:
            observations: ``[L, B, O]`` histories, scaled as the networks see them.
            proximity: ``[L, B]`` in [0, 1], for policies that take it.
            noise: ``[L, B, N, E]`` standard normal, for policies that choose among N candidates.

        Returns:
            Actions ``[L, B, A]`` in [-1, 1]; differentiable, unless chosen among candidates.
        """

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""


class Scalars(nn.Module):
    """One learned number per lane, such as a multiplier: ``value [L]``."""

    def __init__(self, lanes: int, initial: float) -> None:
        super().__init__()
        self.value = nn.Parameter(torch.full((lanes,), initial))


def adam_each(
    networks: Mapping[str, nn.Module], rates: Mapping[str, float]
) -> dict[str, torch.optim.Optimizer]:
    """An Adam optimiser for each network that is given a learning rate."""
    return {name: adam(list(networks[name].parameters()), rate) for name, rate in rates.items()}


def gather_gradients(whole: nn.Module, parts: Sequence[nn.Module]) -> None:
    """Give a stack the gradients of its parts, see :func:`~components.networks.lane_groups`."""
    if parts[0] is whole:
        return
    for parameter, *own in zip(whole.parameters(), *(p.parameters() for p in parts), strict=True):
        parameter.grad = torch.cat([p.grad for p in own if p.grad is not None])


def descend(optimizer: torch.optim.Optimizer, loss: Tensor) -> None:
    """Step ``optimizer`` down the gradient of ``loss [L]``, summed over lanes.

    Only the optimiser's own parameters get a gradient: for an actor's loss, no time is spent on the
    gradients of the critic's weights.
    """
    parameters = [p for group in optimizer.param_groups for p in group["params"]]
    gradients = torch.autograd.grad(loss, parameters, torch.ones_like(loss))
    for parameter, gradient in zip(parameters, gradients, strict=True):
        parameter.grad = gradient
    optimizer.step()


def bootstrapped(batch: Batch, discount: float, values: Tensor) -> Tensor:
    """Targets ``r + gamma (1 - terminal) V`` of transitions, ``[L, B]``.

    Args:
        batch: Transitions.
        discount: gamma.
        values: ``[L, B]`` V of the next states.
    """
    return torch.addcmul(batch.rewards, batch.continues, values, value=discount)


def needed(given: Tensor | None, what: str) -> Tensor:
    """Return a required input of :meth:`PolicyLearner.act`.

    Raises:
        ValueError: If it is None.
    """
    if given is None:
        raise ValueError(f"These policies need {what}.")
    return given


def saturation(actions: Tensor) -> Tensor:
    """Share of action entries on a bound (beyond 0.99), ``[L]``."""
    beyond = actions.detach().abs() > SATURATED
    return beyond.flatten(1).mean(dim=1, dtype=actions.dtype)

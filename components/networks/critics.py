"""Ensembles of action values: K critics a lane, all lanes and critics in one stack."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn.functional import mse_loss

from components.core.random_streams import spawn_generators
from components.networks.stacked import StackedMLP, first_layer_over_actions

__all__ = ["Critics", "soft_clipped_maximum"]


class Critics(nn.Module):
    """K state-action value networks for each of L lanes, stored as ``L * K`` lanes, lane-major.

    Args:
        keys: One random stream per lane.
        observations: Width O, including the proximity where the critic takes it.
        actions: Width A.
        hidden: Layer widths.
        count: K.
    """

    def __init__(
        self,
        keys: Sequence[int],
        observations: int,
        actions: int,
        hidden: Sequence[int],
        count: int = 2,
    ) -> None:
        super().__init__()
        self.count = count
        of_each = [spawn_generators(keys, f"critic{number}") for number in range(count)]
        generators = [of_each[number][lane] for lane in range(len(keys)) for number in range(count)]
        self.stack = StackedMLP(generators, (observations + actions, *hidden, 1))

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Values ``[L, K, B]`` of ``observations [L, B, O]`` and ``actions [L, B, A]``."""
        each = [x[:, None].expand(-1, self.count, -1, -1) for x in (observations, actions)]
        values: Tensor = self.stack(torch.cat(each, dim=-1).flatten(0, 1))
        return values.view(-1, self.count, values.shape[1])

    def over_actions(self, observations: Tensor, actions: Tensor) -> Tensor:
        """Values ``[L, K, B, N]`` of N actions ``[L, B, N, A]`` at every observation."""
        values = self.stack.over_actions(self._repeat(observations), self._repeat(actions))
        return values.view(-1, self.count, *actions.shape[1:3])

    def errors(self, observations: Tensor, actions: Tensor, targets: Tensor) -> Tensor:
        """Mean squared distance of every critic to ``targets [L, B]``: ``[L, K]``."""
        values: Tensor = self(observations, actions)
        wanted = targets[:, None].expand_as(values)
        return mse_loss(values, wanted, reduction="none").mean(dim=2)

    def least(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The least value ``[L, B]`` of all critics, for an actor to learn from.

        Its gradient with respect to ``actions [L, B, A]`` is cheaper than the forward pass's.
        """
        values = self.over_actions(observations, actions[:, :, None]).squeeze(-1)
        return values.min(dim=1).values  # of which the gradient is a scatter; that of amin is not

    def first(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The first critic's values ``[L, B]``, without computing the others."""
        (weight, bias), *rest = self.first_network()
        x = first_layer_over_actions(weight, bias, observations, actions[:, :, None])
        for weight, bias in rest:
            x = torch.baddbmm(bias, torch.relu_(x), weight)
        return x.squeeze(-1)

    def best_action(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The action ``[L, B, A]`` of greatest first-critic value among N, ``[L, B, N, A]``."""
        values = self.over_actions(observations, actions)[:, 0].nan_to_num(nan=-torch.inf)
        best = values.argmax(dim=-1)[..., None, None]
        return actions.gather(2, best.expand(-1, -1, 1, actions.shape[-1])).squeeze(2)

    def first_network(self) -> list[tuple[Tensor, Tensor]]:
        """Weights and biases of every lane's first critic."""
        return [(w[:: self.count], b[:: self.count]) for w, b in self.stack.affine()]

    def _repeat(self, x: Tensor) -> Tensor:
        """The same input for all critics of a lane: ``[L, ...]`` to ``[L * K, ...]``."""
        return x[:, None].expand(-1, self.count, *x.shape[1:]).flatten(0, 1)


def soft_clipped_maximum(values: Tensor, weight: float) -> Tensor:
    """Soft clipped double Q (BCQ, equation 13), then the best of N actions.

    Args:
        values: ``[L, K, B, N]``.
        weight: Of the least critic against the greatest, action by action.

    Returns:
        ``[L, B]``.
    """
    least, greatest = torch.aminmax(values, dim=1)
    return torch.lerp(greatest, least, weight).amax(dim=-1)

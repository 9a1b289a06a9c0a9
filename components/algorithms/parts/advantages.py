"""Advantages of trajectories of equal length, on stacked lanes: baseline, estimates, whitening.

As in the code behind MOReL (mjrl): the baseline reads the time as well as the state, since a return
ends at the horizon. It is fitted after the policy step, so that it has not been fitted to the
returns whose advantages it computes.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from components.core.random_streams import spawn_generators
from components.networks import StackedMLP, lanewise_mean

__all__ = ["Baseline", "discounted_returns", "generalised_advantages", "whitened"]

_POWERS = 4  # of the time


class Baseline(nn.Module):
    """L value networks ``V(s, t)``.

    Args:
        keys: One random stream per lane.
        observations: Width O.
        hidden: Layer widths.
        horizon: Steps T of a trajectory; time enters as a share of it, to the powers 1 to 4.
        scale: ``[L]`` typical size of a return; the networks' outputs are multiples of it.
    """

    def __init__(
        self,
        keys: Sequence[int],
        observations: int,
        hidden: Sequence[int],
        horizon: int,
        scale: Tensor,
    ) -> None:
        super().__init__()
        sizes = (observations + _POWERS, *hidden, 1)
        self.stack = StackedMLP(spawn_generators(keys, "critic"), sizes)
        self._scale = scale[:, None]
        time = torch.arange(horizon + 1, device=scale.device)[:, None] / horizon
        self._clock = time ** torch.arange(1, _POWERS + 1, device=scale.device)  # [T + 1, 4]

    def forward(self, observations: Tensor, time: Tensor) -> Tensor:
        """Values ``[L, B]`` of ``observations [L, B, O]`` before the steps ``time [L, B]``."""
        values: Tensor = self.stack(torch.cat([observations, self._clock[time]], dim=-1))
        return values.squeeze(-1) * self._scale

    def loss(self, observations: Tensor, time: Tensor, returns: Tensor) -> Tensor:
        """Mean squared error ``[L]`` against ``returns [L, B]``, in units of the scale's square."""
        error: Tensor = self(observations, time) - returns
        return lanewise_mean((error / self._scale).square())


def generalised_advantages(
    rewards: Tensor, values: Tensor, continues: Tensor, discount: float, trace: float
) -> Tensor:
    """Generalised advantage estimates (Schulman et al. 2016), ``[T, ...]``.

    Args:
        rewards: ``[T, ...]``.
        values: ``[T + 1, ...]`` of the states before each step and after the last one, which is a
            time-out unless it is terminal.
        continues: ``[T, ...]`` 0 where the step's next state is terminal: neither its value nor
            any later step counts; 1 elsewhere.
        discount: gamma.
        trace: lambda.
    """
    errors = rewards + discount * continues * values[1:] - values[:-1]  # temporal differences
    advantage, backwards = torch.zeros_like(errors[0]), []
    for error, goes_on in zip(errors.flip(0), continues.flip(0), strict=True):
        advantage = error + discount * trace * goes_on * advantage
        backwards.append(advantage)
    return torch.stack(backwards[::-1])


def discounted_returns(rewards: Tensor, continues: Tensor, discount: float) -> Tensor:
    """Returns from every step to the end of its trajectory, ``[T, ...]`` like the rewards."""
    zeros = torch.zeros_like(rewards[:1]).expand(len(rewards) + 1, *rewards.shape[1:])
    return generalised_advantages(rewards, zeros, continues, discount, 1.0)


def whitened(estimates: Tensor, counts: Tensor) -> Tensor:
    """Estimates ``[L, N]`` with mean 0 and deviation 1 over the samples that count, 0 elsewhere.

    Args:
        estimates: ``[L, N]``.
        counts: ``[L, N]`` whether a sample counts; at least one in every lane does.
    """
    share = counts / counts.sum(dim=1, keepdim=True)
    centred = estimates - (share * estimates).sum(dim=1, keepdim=True)
    spread = (share * centred.square()).sum(dim=1, keepdim=True).sqrt()
    return counts * centred / (spread + 1e-6)

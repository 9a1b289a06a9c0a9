"""Fitted Q evaluation: the value of given policies, learned from logged transitions.

Le, Voloshin, Yue, "Batch Policy Learning under Constraints" (2019). A critic of each policy follows

    Q(s, a) = r + gamma (1 - terminal) Q_target(s', pi(s'))

on transitions of the log, and the value of the policy is the mean of Q(s, pi(s)) over start states.
All policies learn in one stack of lanes, several replicas of each. What a policy does in the log's
states does not change while its critic learns: it is computed once.

Rewards are standardised. Without terminal states their mean is taken off, too, which leaves the
critics only the differences between states to learn; it is added again in the end. No value is
above that of the log's best reward for ever, or below that of its worst: targets are clipped to
this range, without which critics of actions far from the log grow without bound.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from torch import Tensor

from components.core.draws import Integers
from components.core.random_streams import LaneStreams, lane_generator, lane_key
from components.data.batches import LaneData
from components.judging.config import JudgeConfig
from components.networks.stacked import StackedMLP, polyak_update
from components.training.cuda_graphs import graphed
from components.training.loop import TrainingLoop, adam
from components.training.stacked_learner import StackedLearner

__all__ = ["FittedQ", "policy_values"]


class FittedQ(StackedLearner):
    """The critics of Q policies, R replicas each: lanes ``[R, Q]``.

    Args:
        data: The log, as R lanes.
        rows: Transitions that critics learn from, ``[n]``.
        next_actions: What the policies do in the states after these, ``[Q, n, A]``.
        config: Widths and rates.
        key: Random stream; all policies have the same initial weights and batches.
    """

    def __init__(
        self,
        data: LaneData,
        rows: Tensor,
        next_actions: Tensor,
        config: JudgeConfig,
        key: int,
    ) -> None:
        self._data, self._rows, self._next_actions = data, rows, next_actions
        self._policies, self._replicas = len(next_actions), data.lanes
        self.lanes = self._policies * self._replicas
        self._discount = data.datasets[0].card.discount
        self._config = config
        keys = [lane_key(key, replica) for replica in range(self._replicas)]
        weights = [lane_key(own, "weights") for own in keys for _ in range(self._policies)]
        sizes = (data.observation_width + data.action_width, *config.hidden, 1)
        self.critic, self.target = (
            StackedMLP([lane_generator(own) for own in weights], sizes).to(data.device)
            for _ in range(2)
        )
        self._networks = {"critic": self.critic, "target": self.target}
        self._optimizer = adam(list(self.critic.parameters()), config.learning_rate)
        self._optimizers = {"critic": self._optimizer}
        draw = Integers([len(rows)] * self._replicas, config.batch)
        self._streams = LaneStreams(keys, {"row": draw}, data.device)
        logged = data.batch(rows.expand(self._replicas, -1))
        rewards = logged.rewards[0].double()
        self._ends = not bool(logged.continues.all())
        self._mean = 0.0 if self._ends else float(rewards.mean())
        self._scale = float(rewards.std(correction=0)) or 1.0
        least, most = ((float(end) - self._mean) / self._scale for end in rewards.aminmax())
        if self._ends:  # nothing is earned after the end
            least, most = min(least, 0.0), max(most, 0.0)
        self._range = (-math.inf, math.inf)
        if self._discount < 1.0:
            self._range = least / (1.0 - self._discount), most / (1.0 - self._discount)

    def update(self, step: int) -> dict[str, Tensor]:
        """One step of all critics towards their targets."""
        drawn = self._streams.at(step)["row"]  # [R, B]
        batch = self._data.batch(self._rows[drawn])
        following = self._next_actions[:, drawn].transpose(0, 1)  # [R, Q, B, A]
        with torch.no_grad():
            future = self._value(self.target, batch.next_observations, following)
            future = future.clamp(*self._range)
            rewards = (batch.rewards - self._mean) / self._scale
            continues = batch.continues[:, None].expand_as(future)
            targets = torch.addcmul(
                rewards[:, None].expand_as(future), continues, future, value=self._discount
            )
        logged = batch.actions[:, None].expand_as(following)
        errors = self._value(self.critic, batch.observations, logged) - targets
        loss = errors.square().mean(dim=2).flatten()
        self._optimizer.zero_grad(set_to_none=True)
        loss.sum().backward()
        self._optimizer.step()
        polyak_update([(self.target, self.critic)], self._config.target_rate)
        return {"fitted_q/loss": loss.detach()}

    @torch.no_grad()
    def values(self, observations: Tensor, actions: Tensor, horizon: int) -> Tensor:
        """Discounted returns over a horizon, ``[R, Q, B]``.

        Critics know no horizon. Where nothing ends by itself, the part of an endless sum of equal
        rewards that lies within it is taken; elsewhere the values are left as they are.

        Args:
            observations: ``[R, B, O]`` scaled start states, equal for all replicas.
            actions: ``[Q, B, A]`` of the policies there.
            horizon: Steps.
        """
        shape = (self._replicas, *actions.shape)
        found = self._value(self.critic, observations, actions.expand(shape))
        if self._ends:
            return found * self._scale
        if self._discount == 1.0:
            return found * self._scale + self._mean * horizon
        within = 1.0 - math.pow(self._discount, horizon)
        return (found * self._scale + self._mean / (1.0 - self._discount)) * within

    def _value(self, critic: StackedMLP, observations: Tensor, actions: Tensor) -> Tensor:
        """``[R, Q, B]`` of observations ``[R, B, O]`` and actions ``[R, Q, B, A]``."""
        seen = observations[:, None].expand(-1, self._policies, -1, -1).flatten(0, 1)
        return critic.over_actions(seen, actions.flatten(0, 1)[:, :, None]).view(actions.shape[:3])


def policy_values(
    data: LaneData,
    rows: Tensor,
    next_actions: Tensor,
    starts: tuple[Tensor, Tensor],
    config: JudgeConfig,
    key: int,
    *,
    names: Sequence[str],
    checkpoint: Path | None = None,
    progress: Callable[[float], None] = lambda fraction: None,
) -> Tensor:
    """Evaluate policies by fitted critics.

    Args:
        data: The log, as R lanes.
        rows: Transitions that critics learn from, ``[n]``.
        next_actions: What the policies do in the states after these, ``[Q, n, A]``.
        starts: Observations ``[R, B, O]`` of start states, and the policies' actions there
            ``[Q, B, A]``.
        config: Settings.
        key: Random stream.
        names: Of the policies, stable across restarts.
        checkpoint: File to resume from and save to.
        progress: Called with the finished fraction of the budget, 0 to 1.

    Returns:
        Discounted returns over the horizon of the returns on the card, ``[R, Q, B]``.
    """
    learner = FittedQ(data, rows, next_actions, config, key)
    members = [f"{name}#{replica}" for replica in range(data.lanes) for name in names]
    loop = TrainingLoop(config.updates, members, checkpoint, progress=progress)
    loop.run(graphed(learner, data.device), at=())
    return learner.values(*starts, data.datasets[0].card.return_steps)

"""Peers as one writes them without a thought of speed: one copy, one network, plain PyTorch."""

from collections.abc import Callable

import gymnasium as gym
import torch
from torch import Tensor, nn

from components.data.dataset import OfflineDataset
from components.models.behaviour_policy import BehaviourPolicyConfig

__all__ = ["clone_epoch", "evaluation_loop"]


def _network(inputs: int, hidden: tuple[int, ...], outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ReLU()]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs), nn.Tanh())


def evaluation_loop(
    environment: str, parameters: dict[str, object], hidden: tuple[int, ...], horizon: int
) -> Callable[[], float]:
    """A runner of one trajectory of one policy in one copy of a system; it returns the return."""
    system = gym.make(environment, **parameters)
    (inputs,), (outputs,) = system.observation_space.shape, system.action_space.shape
    policy = _network(inputs, hidden, outputs)

    def run() -> float:
        seen, _ = system.reset(seed=0)
        total = 0.0
        with torch.no_grad():
            for _ in range(horizon):
                action = policy(torch.from_numpy(seen)[None])[0]
                seen, reward, *_ = system.step(action.numpy())
                total += float(reward)
        return total

    return run


def clone_epoch(dataset: OfflineDataset, config: BehaviourPolicyConfig) -> Callable[[], None]:
    """A runner of one epoch of cloning, without validation, from observations made beforehand."""
    frames = torch.from_numpy(dataset.frames)[: dataset.transitions]
    history = dataset.card.history
    padded = torch.cat([frames[:1].expand(history - 1, -1), frames])
    # episodes are not told apart: the amount of work is the same
    observations: Tensor = padded.unfold(0, history, 1).flatten(1).contiguous()
    actions = torch.from_numpy(dataset.actions)[: len(observations)]
    network = _network(observations.shape[1], config.hidden, actions.shape[1])
    adam = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    count = int(len(actions) * (1.0 - config.holdout))

    def run() -> None:
        for rows in torch.randperm(count).split(config.batch):
            loss = nn.functional.mse_loss(network(observations[rows]), actions[rows])
            adam.zero_grad()
            loss.backward()
            adam.step()

    return run

"""A robot of three numbers that falls when it strays, for tests of what is logged on robots."""

from collections.abc import Sequence

import numpy as np
import torch

from components.core.normaliser import Normaliser
from components.core.random_streams import spawn_generators
from components.data.controllers.trained.shipped import Expert, ExpertCard
from components.networks import StackedMLP
from components.policies.policy import Policy, PolicyCard

FEATURES = ("place", "speed", "tilt")
LIMIT = 2.0  # of the tilt, beyond which it has fallen


class ToyRobot:
    """N copies; a copy's numbers depend on its start and its actions alone.

    Args:
        copies: N.
        unsteady: How fast the tilt grows; 0 for a robot that hardly ever falls.
    """

    frame_features = FEATURES
    action_features = ("push", "lean")

    def __init__(self, copies: int, unsteady: float = 0.6) -> None:
        self.copies = copies
        self._unsteady = unsteady
        self._state = np.zeros((copies, 3))
        self.terminated = np.zeros(copies, dtype=np.bool_)

    def reset(self, rng: Sequence[np.random.Generator]) -> np.ndarray:
        return self.reset_copies(np.ones(len(self._state), dtype=np.bool_), rng)

    def reset_copies(self, mask: np.ndarray, rng: Sequence[np.random.Generator]) -> np.ndarray:
        assert len(rng) == len(mask)
        self._state[mask] = [rng[n].uniform(-0.1, 0.1, 3) for n in np.flatnonzero(mask)]
        self.terminated = self.terminated & ~mask
        return self._state[mask].copy()

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        place, speed, tilt = self._state.T
        push, lean = actions.T
        moved = np.stack(
            [
                place + 0.1 * speed,
                0.9 * speed + 0.2 * push,
                np.clip(tilt + self._unsteady * lean + 0.05 * speed, -9.0, 9.0),
            ],
            axis=1,
        )
        self._state = moved
        self.terminated = np.abs(moved[:, 2]) > LIMIT
        return moved.copy(), 1.0 + moved[:, 1] - 0.1 * (actions**2).sum(axis=1)


def toy_expert(scale: float = 1.0, features: tuple[str, ...] = FEATURES) -> Expert:
    """An untrained policy of the toy's widths, or of another robot's with two actions."""
    network = StackedMLP(spawn_generators([5], "toy expert"), (len(features), 7, 2))
    layers = [(scale * weight, bias) for weight, bias in network.affine()]
    card = PolicyCard(
        algorithm="ddpg",
        dataset="none",
        features=features,
        history=1,
        actions=2,
        takes_proximity=False,
        steps=(40,),
    )
    as_it_is = Normaliser(torch.zeros(1, len(features)), torch.ones(1, len(features)))
    return Expert(
        Policy.of_networks(card, {"actor": layers}, as_it_is),
        ExpertCard(
            robot="toy",
            environment="toy",
            physics="v3",
            simulator="none",
            seed=0,
            candidates={"0": 1.0, "1": 0.5},
            step=40,
            training={"steps": 60},
            episodes=3,
            return_mean=1.0,
            return_std=0.1,
            return_steps=100,
            discount=0.99,
            discounted_return_mean=0.5,
        ),
    )

"""Training of experts: four seeds as four lanes against one seed in plain eager code.

`python -m benchmarks.experts [--robot swimmer] [--repetitions 3] [--steps 300]`. The peer is DDPG
as single-file implementations such as CleanRL's write it: one Gymnasium environment, a replay ring
of NumPy arrays, modules and optimisers of PyTorch as they come, targets moved parameter by
parameter.
Same layers, batch, exploration and physics, same process, same threads; every step of either is one
environment step per seed and one update. Denormal numbers are rounded to 0 for both: without that
the peer becomes several times slower once Adam's moments of dead units have faded.
"""

import argparse
import copy
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from torch import Tensor, nn

from benchmarks.measure import computer, markdown, median_seconds
from components.core.random_streams import lane_key
from components.environments.mujoco.robots import Robots
from components.environments.mujoco.specifications import ROBOTS
from components.experts.config import ExpertConfig
from components.experts.online import OnlineLearner
from components.experts.replay import Replay
from components.experts.training import without_denormals
from components.training.memory import keep_freed_memory

__all__ = ["EagerDDPG", "lanes_program", "report"]

_SEEDS = 4
_WARM_UP = 1000  # random steps before the clock starts, for batches to be drawn from


def _network(inputs: int, hidden: Sequence[int], outputs: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for width in hidden:
        layers += [nn.Linear(inputs, width), nn.ReLU()]
        inputs = width
    return nn.Sequential(*layers, nn.Linear(inputs, outputs))


class EagerDDPG:
    """One seed, step by step, as it is usually written.

    Args:
        config: Settings.
        robot: Its name.
        seed: Of everything random.
    """

    def __init__(self, config: ExpertConfig, robot: str, seed: int) -> None:
        self.config = config
        self.environment = gym.make(ROBOTS[robot].id, physics="v3")
        self.rng = np.random.default_rng(seed)
        self.frame, _ = self.environment.reset(seed=seed)
        (self.observations,), (self.actions,) = (
            self.environment.observation_space.shape,
            self.environment.action_space.shape,
        )
        self.actor = _network(self.observations, config.hidden, self.actions)
        self.critic = _network(self.observations + self.actions, config.hidden, 1)
        self.actor_target = copy.deepcopy(self.actor)
        self.critic_target = copy.deepcopy(self.critic)
        rate = config.learning_rate
        self.actor_adam = torch.optim.Adam(self.actor.parameters(), lr=rate)
        self.critic_adam = torch.optim.Adam(self.critic.parameters(), lr=rate)
        size = config.steps
        self.seen = np.zeros((size, self.observations), dtype=np.float32)
        self.after = np.zeros((size, self.observations), dtype=np.float32)
        self.acted = np.zeros((size, self.actions), dtype=np.float32)
        self.paid, self.ended = (np.zeros(size, dtype=np.float32) for _ in range(2))
        self.count = 0

    def step(self) -> None:
        """One environment step and, after the random ones, one update."""
        learns = self.count >= self.config.random_steps
        if learns:
            with torch.no_grad():
                wanted = torch.tanh(self.actor(torch.Tensor(self.frame)))
                wanted += torch.normal(0.0, self.config.exploration * torch.ones(self.actions))
            action = wanted.numpy().clip(-1.0, 1.0)
        else:
            action = self.rng.uniform(-1.0, 1.0, self.actions)
        following, reward, terminated, truncated, _ = self.environment.step(action)
        row = self.count
        self.seen[row], self.acted[row], self.after[row] = self.frame, action, following
        self.paid[row], self.ended[row] = reward, terminated
        self.count += 1
        self.frame = following
        if terminated or truncated:
            self.frame, _ = self.environment.reset()
        if learns:
            rows = self.rng.integers(self.count, size=self.config.batch)
            arrays = (self.seen, self.acted, self.paid, self.after, self.ended)
            self.update(*(torch.tensor(array[rows]) for array in arrays))

    def update(
        self, seen: Tensor, acted: Tensor, paid: Tensor, after: Tensor, ended: Tensor
    ) -> None:
        """One update of critic, actor and targets on a batch of transitions."""
        with torch.no_grad():
            following = torch.tanh(self.actor_target(after))
            values = self.critic_target(torch.cat([after, following], 1)).view(-1)
            target = paid + (1.0 - ended) * self.config.discount * values
        fit = self.critic(torch.cat([seen, acted], 1)).view(-1)
        loss = nn.functional.mse_loss(fit, target)
        self.critic_adam.zero_grad()
        loss.backward()
        self.critic_adam.step()
        own = torch.tanh(self.actor(seen))
        loss = -self.critic(torch.cat([seen, own], 1)).mean()
        self.actor_adam.zero_grad()
        loss.backward()
        self.actor_adam.step()
        rate = self.config.target_rate
        for online, slow in (
            (self.actor, self.actor_target),
            (self.critic, self.critic_target),
        ):
            for new, old in zip(online.parameters(), slow.parameters(), strict=True):
                old.data.copy_(rate * new.data + (1.0 - rate) * old.data)


def lanes_program(
    config: ExpertConfig, robot: str, seeds: Sequence[int], folder: Path
) -> OnlineLearner:
    """Our learner as training makes it, with one lane per seed and its files in a folder."""
    robots = Robots(ROBOTS[robot], len(seeds), "v3")
    widths = len(robots.frame_features), len(robots.action_features)
    device = torch.device("cpu")
    files = [folder / f"{len(seeds)}-lanes-{seed}" for seed in seeds]
    replay = Replay(len(seeds), config.steps, *widths, device, files)
    keys = [lane_key("expert", robot, seed) for seed in seeds]
    return OnlineLearner(config, keys, robots, replay, device)


def _further(update: Callable[[int], object], warm_up: int, steps: int) -> Callable[[], None]:
    """A runner of `steps` further steps, past the random ones."""
    done = 0
    while done < warm_up:
        update(done)
        done += 1

    def run() -> None:
        nonlocal done
        for step in range(done, done + steps):
            update(step)
        done += steps

    return run


def report(
    robot: str = "swimmer",
    repetitions: int = 3,
    steps: int = 300,
    hidden: tuple[int, ...] = (400, 300),
) -> str:
    """Measure all; a Markdown table.

    Args:
        robot: Its name.
        repetitions: Timings per row, the median counts.
        steps: Per timing and program.
        hidden: Layers.
    """
    keep_freed_memory()
    size = _WARM_UP + (repetitions + 1) * steps
    config = ExpertConfig(steps=size, random_steps=_WARM_UP, evaluate_every=size, hidden=hidden)
    with tempfile.TemporaryDirectory() as name, without_denormals():
        eager = EagerDDPG(config, robot, 0)
        programs: dict[str, tuple[int, Callable[[int], object]]] = {
            "eager, 1 seed": (1, lambda step: eager.step()),
            "ours, 1 lane": (1, lanes_program(config, robot, [0], Path(name)).update),
            f"ours, {_SEEDS} lanes": (
                _SEEDS,
                lanes_program(config, robot, range(_SEEDS), Path(name)).update,
            ),
        }
        runs = {n: _further(update, _WARM_UP, steps) for n, (_, update) in programs.items()}
        seconds = median_seconds(runs, repetitions)
    rates = {n: steps / seconds[n] for n in programs}
    rows = []
    for program, (seeds, _) in programs.items():
        cells = [f"{rates[program]:,.1f}", f"{rates[program] * seeds:,.1f}"]
        cells.append(f"{rates[program] * seeds / rates['eager, 1 seed']:.2f}")
        rows.append([robot, program, *cells])
    columns = ["robot", "program", "updates/s", "seed-updates/s", "times"]
    return markdown(columns, rows, texts=2)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.experts", description=__doc__)
    parser.add_argument("--robot", choices=ROBOTS, default="swimmer")
    parser.add_argument("--repetitions", type=int, default=3)
    parser.add_argument("--steps", type=int, default=300)
    options = parser.parse_args()
    print(report(options.robot, options.repetitions, options.steps))
    print(f"\n{computer()}")


if __name__ == "__main__":
    main()

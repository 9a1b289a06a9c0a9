"""Online training: every lane has one environment, one replay memory and one learner.

In every environment step each lane acts (uniformly at random in the first steps, then by its policy
with Gaussian noise) and stores the transition. Once it acts by its policy, it also makes one update
on a batch drawn uniformly from the replay memory. An episode ends with a fall, which is terminal,
or at the time limit, which is not.

On a GPU the update is a CUDA graph; the step of the system, which runs on the host and needs an
action from the device every time, is not: a dozen launches, a copy to and one from the device, by
estimate 0.1 to 0.2 ms a step, in which the host would wait for the device anyway.

The transitions of a lane depend on its key alone: starts are drawn from (key, episode number),
everything else from (key, step). Checkpoints do not hold the state of the simulator: a resumed run
repeats the current episode from its start with the stored actions, which gives the same state.
"""

import copy
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from components.core.draws import Normal, Uniform
from components.core.random_streams import LaneStreams, lane_generator, lane_key
from components.experts.config import ExpertConfig
from components.experts.replay import Replay
from components.experts.replayed import replayed_learner
from components.networks import StackedMLP
from components.training.cuda_graphs import graphed
from components.training.state import module_state, with_prefix

if TYPE_CHECKING:  # MuJoCo is slow to import, and plans read settings alone
    from components.environments.mujoco.robots import Robots

__all__ = ["OnlineLearner"]

Mask = npt.NDArray[np.bool_]


class OnlineLearner:
    """L learners that collect their own transitions.

    Args:
        config: Settings.
        keys: One random stream per lane.
        robots: L copies of the system.
        replay: Empty replay memory of L lanes.
        device: Where to learn.
    """

    def __init__(
        self,
        config: ExpertConfig,
        keys: Sequence[int],
        robots: "Robots",
        replay: Replay,
        device: torch.device,
    ) -> None:
        self.lanes = len(keys)
        self._config, self._keys, self._device = config, list(keys), device
        self._robots, self._replay = robots, replay
        widths = len(robots.frame_features), len(robots.action_features)
        self._learner = replayed_learner(config, keys, replay, widths, device)
        self._learning = graphed(self._learner, device)
        self._best = copy.deepcopy(self._learner.actor).requires_grad_(False)
        self._best_return = torch.full((self.lanes,), -torch.inf, dtype=torch.float64)
        self._best_step = torch.zeros(self.lanes, dtype=torch.int64)
        self._streams = LaneStreams(
            keys,
            {
                "uniform": Uniform(widths[1], low=-1.0),
                "noise": Normal(widths[1]),
            },
            device,
        )
        self._episode = np.zeros(self.lanes, dtype=np.int64)
        self._elapsed = np.zeros(self.lanes, dtype=np.int64)
        self._frames = robots.reset(self._start_generators())

    # -- update -----------------------------------------------------------------------------

    def update(self, step: int) -> dict[str, Tensor]:
        """One environment step on all lanes and, after the random ones, one update."""
        random = self._streams.at(step)
        learns = step >= self._config.random_steps
        self._interact(self._noisy_actions(random["noise"]) if learns else random["uniform"])
        if not learns:
            return {}
        return self._learning.update(step)

    @torch.no_grad()
    def _noisy_actions(self, noise: Tensor) -> Tensor:
        frames = torch.from_numpy(self._frames).float().to(self._device)
        wanted = torch.tanh(self._learner.actor(frames[:, None])).squeeze(1)
        noisy = (wanted + self._config.exploration * noise).clamp_(-1.0, 1.0)
        return noisy.nan_to_num_()  # a diverged lane must not make the simulations unstable

    def _interact(self, actions: Tensor) -> None:
        taken = actions.float().cpu().numpy()
        frames, rewards = self._robots.step(taken.astype(np.float64))
        fallen = self._robots.terminated
        self._replay.append(self._frames, taken, rewards, fallen, frames)
        self._elapsed += 1
        self._frames = frames
        ended = fallen | (self._elapsed == self._config.horizon)
        if ended.any():
            self._episode[ended] += 1
            self._elapsed[ended] = 0
            self._begin(ended)

    def _begin(self, lanes: Mask) -> None:
        """Put lanes at the start of their current episode."""
        self._frames[lanes] = self._robots.reset_copies(lanes, self._start_generators())

    def _start_generators(self) -> list[np.random.Generator]:
        """Per lane the generator of its current episode's start."""
        return [
            lane_generator(lane_key(key, "start"), int(number))
            for key, number in zip(self._keys, self._episode, strict=True)
        ]

    # -- what is kept -------------------------------------------------------------------------

    @property
    def actor(self) -> StackedMLP:
        """The current policies' networks; the action is the tanh of their output."""
        return self._learner.actor

    @property
    def best(self) -> StackedMLP:
        """Of each lane the network with the highest return so far."""
        return self._best

    @property
    def best_return(self) -> list[float]:
        """Return of the best network, per lane."""
        values: list[float] = self._best_return.tolist()
        return values

    @property
    def best_step(self) -> list[int]:
        """The step at which the best network was evaluated, per lane."""
        values: list[int] = self._best_step.tolist()
        return values

    @torch.no_grad()
    def keep_best(self, step: int, returns: Tensor) -> None:
        """Keep the current policies of the lanes whose return is their highest so far.

        Only finite policies of a finite return are kept.

        Args:
            step: Steps so far.
            returns: ``[L]`` mean returns of the current policies.
        """
        better = returns.isfinite() & (returns > self._best_return)
        for parameter in self.actor.parameters():
            better &= parameter.reshape(self.lanes, -1).isfinite().all(dim=1).cpu()
        self._best_return[better] = returns[better]
        self._best_step[better] = step
        chosen = better.to(self._device)
        for kept, now in zip(self._best.parameters(), self.actor.parameters(), strict=True):
            kept[chosen] = now[chosen]

    def state_dict(self) -> dict[str, Tensor]:
        """All that the next update depends on except the transitions, which are in files."""
        return {
            **self._learner.state_dict(),
            **module_state({"best": self._best}),
            "best_return": self._best_return,
            "best_step": self._best_step,
            "collected": torch.full((self.lanes,), self._replay.count),
            "transitions": self._replay.digests(),
            "episode": torch.from_numpy(self._episode.copy()),
            "elapsed": torch.from_numpy(self._elapsed.copy()),
        }

    def load_state_dict(self, state: dict[str, Tensor]) -> None:
        """Restore what :meth:`state_dict` returned, and repeat the running episodes.

        Raises:
            DamagedFileError: The files hold other transitions than those the state counts.
        """
        self._learner.load_state_dict(state)
        self._best.load_state_dict(with_prefix("best", state))
        self._best_return = state["best_return"].clone()
        self._best_step = state["best_step"].clone()
        self._episode = state["episode"].numpy().copy()
        self._elapsed = state["elapsed"].numpy().copy()
        self._replay.restore(int(state["collected"][0]), state["transitions"])
        for back in range(int(self._elapsed.max()), -1, -1):
            begins = self._elapsed == back
            if begins.any():
                self._begin(begins)
            if back:
                # Lanes whose episode has not begun yet act, too; its start resets them.
                past = np.full(self.lanes, self._replay.count - back)
                actions = self._replay.actions(past).astype(np.float64)
                self._frames = self._robots.step(actions)[0]

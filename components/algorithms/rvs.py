"""RvS-R: supervised learning conditioned on the return to be achieved.

Emmons, Eysenbach, Kostrikov, Levine, "RvS: What is Essential for Offline RL via Supervised
Learning?" (2022); the comparison of thesis chapter 6. A Gaussian policy with one learned standard
deviation per action entry maximises the likelihood of the logged actions given the observation and
the return that the log achieved from there:

    loss = -mean log N(a; mu(s, w), sigma^2),   w_t = sum_{k < 100} gamma^k r_{t+k}

Deployed is the mean, clipped to the action box, for a wanted return that is constant in an
episode. Here the proximity sets it: 0 asks for the mean return of the log, 1 for its best return
over 100 steps. After a terminal state rewards are 0.

The authors condition on the average reward to go; the thesis speaks of the return, on whose
discounted scale its figure is drawn, so that is taken, over the window in which policies are
evaluated (the last steps of a trajectory have no such window and are left out). More deviations:
batches of 256, shuffled, for 10,000 updates instead of 16,384 for 2,000 epochs; PyTorch's default
initial weights; observation and return are standardised.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch
from torch import Tensor, nn

from components.algorithms.parts.algorithm import Algorithm, per_transition
from components.algorithms.parts.learner import LearnerInputs, descend, needed, saturation
from components.algorithms.parts.ranges import check_at_least_one
from components.core.draws import Choice
from components.core.normaliser import Normaliser
from components.core.random_streams import LaneStreams, spawn_generators
from components.data.dataset import OfflineDataset
from components.data.returns import window_returns
from components.networks import StackedMLP, lanewise_mean
from components.policies.policy import Policy, PolicyCard
from components.training.loop import adam
from components.training.stacked_learner import StackedLearner

__all__ = ["ALGORITHM", "Config", "Learner", "achieved_returns"]


@dataclass(frozen=True, kw_only=True)
class Config:
    """The authors' network and rate, with the benchmark's budget and return."""

    updates: int = 10_000
    hidden: tuple[int, ...] = (1024, 1024)  # policy layers
    learning_rate: float = 1e-3  # Adam
    batch: int = 256  # transitions per update
    discount: float = 0.97  # gamma
    window: int = 100  # steps of the return that is conditioned on

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "batch", "window", "hidden")
        if self.learning_rate <= 0 or not 0 < self.discount <= 1:
            raise ValueError("learning_rate must be positive and discount lie in (0, 1].")


def achieved_returns(dataset: OfflineDataset, config: Config) -> tuple[np.ndarray, np.ndarray]:
    """Transitions that begin a whole window, and its return.

    At proximity 0 a policy is asked for the mean of these returns, at 1 for the greatest.
    """
    rows, returns = [], []
    for start, end in zip(dataset.episode_starts[:-1], dataset.episode_starts[1:], strict=True):
        absorbed = config.window - 1 if dataset.terminated[end - 1] else 0
        if end - start + absorbed >= config.window:
            padded = np.pad(dataset.rewards[start:end], (0, absorbed))
            of_episode = window_returns(padded, config.discount, config.window)
            rows.append(start + np.arange(len(of_episode)))
            returns.append(of_episode)
    if not rows:
        raise ValueError(
            f"No trajectory of {dataset.card.name} has window={config.window} steps; lower window."
        )
    return np.concatenate(rows), np.concatenate(returns)


class _Head(nn.Module):
    """One learned log standard deviation per lane and action entry."""

    def __init__(self, lanes: int, actions: int) -> None:
        super().__init__()
        self.log_std = nn.Parameter(torch.zeros(lanes, 1, actions))


class Learner(StackedLearner):
    """A stack of RvS-R policies, one lane per (dataset, seed)."""

    updates_per_graph = 50

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._data = data = inputs.data
        device, self.lanes = data.device, data.lanes
        sizes = (data.observation_width + 1, *config.hidden, data.action_width)
        self._actor = StackedMLP(spawn_generators(inputs.keys, "actor"), sizes).to(device)
        self._head = _Head(self.lanes, data.action_width).to(device)
        self._networks = {"actor": self._actor, "head": self._head}
        learned = [*self._actor.parameters(), *self._head.parameters()]
        self._optimizers = {"actor": adam(learned, config.learning_rate)}
        windows = [achieved_returns(dataset, config) for dataset in data.datasets]
        scaled, scalings = [], []
        for rows, returns in windows:
            scaling = Normaliser.fit(returns[:, None])
            everywhere = np.zeros(max(data.counts), np.float32)
            everywhere[rows] = scaling.apply(torch.from_numpy(returns[:, None])).squeeze(1).numpy()
            scaled.append(torch.from_numpy(everywhere))
            # Proximity 0 asks for the mean and 1 for the best: affine in the scaled return.
            best = torch.tensor([returns.max() - returns.mean()]).float().clamp(min=1e-6)
            scalings.append(Normaliser(torch.zeros(1), scaling.scale / best))
        self._returns = torch.stack(scaled).to(device)  # [L, N], scaled
        self._proximity_scaling = Normaliser.stack(scalings).to(device)  # [L, 1]
        row = Choice([rows for rows, _ in windows], config.batch)
        self._streams = LaneStreams(inputs.keys, {"row": row}, device)

    # -- networks ---------------------------------------------------------------------------

    def _means(self, observations: Tensor, wanted: Tensor) -> Tensor:
        """Mean actions ``[L, B, A]`` for scaled returns ``wanted [L, B]``."""
        means: Tensor = self._actor(torch.cat([observations, wanted[..., None]], dim=-1))
        return means

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        scaling = self._proximity_scaling
        wanted = (needed(proximity, "proximity") - scaling.mean) / scaling.scale
        return self._means(observations, wanted).clamp(-1.0, 1.0)

    # -- update -----------------------------------------------------------------------------

    def update(self, step: int) -> dict[str, Tensor]:
        """One step up the likelihood on all lanes."""
        index = self._streams.at(step)["row"]
        means = self._means(self._data.observations(index), self._returns.gather(1, index))
        log_std = self._head.log_std
        error = self._data.actions(index) - means
        standardised = error * torch.exp(-log_std)
        surprise = torch.addcmul(log_std, standardised, standardised, value=0.5).sum(dim=-1)
        loss = lanewise_mean(surprise) + error.shape[-1] * 0.5 * np.log(2.0 * np.pi)
        descend(self._optimizers["actor"], loss)
        return {
            "actor/loss": loss.detach(),
            "actor/imitation_error": lanewise_mean(error.detach().square()),
            "actor/saturated_share": saturation(means),
            "actor/std": log_std.detach().exp().mean(dim=(1, 2)),
        }

    # -- what is deployed ---------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        return Policy.of_networks(
            replace(card, kind="clipped"),
            {"actor": self._actor.affine()},
            self._data.frame_scaling,
            self._proximity_scaling,
        )


ALGORITHM: Final = Algorithm(
    name="rvs",
    config=Config,
    learner=Learner,
    version=2,
    cost=per_transition(6e-5),
    takes_proximity=True,
    frame_epsilon=1e-3,
)

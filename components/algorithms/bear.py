"""BEAR: an actor held to the support of the logged actions by the maximum mean discrepancy.

Kumar et al., "Stabilizing Off-Policy Q-Learning via Bootstrapping Error Reduction" (2019), in the
form of the port that the authors recommend over their first code (the one of the D4RL evaluations;
where the two disagree the port is taken). A conditional VAE models the logged actions, the actor is
a squashed Gaussian. Per update, on one batch:

    VAE:     mean (D(s, z) - a)^2 + KL / 2, as in BCQ
    y        = r + gamma (1 - terminal) max_i [0.75 min_j Q_target_j(s', a'_i) + 0.25 max_j ...],
               ten a'_i from the current actor
    critics: sum_j mean (Q_j(s, a) - y)^2
    MMD(s)   = sqrt(mean k(x, x') + mean k(y, y') - 2 mean k(x, y) + 1e-6), four x from the VAE,
               four y from the actor, before the tanh; Laplacian kernel exp(-|u - v|_1 / (2 sigma))
    actor:   mean [-min_j Q_j(s, a_1) + alpha (MMD(s) - 0.05)], without Q in the warm-up
    alpha:   log alpha ascends alpha (MMD - 0.05), then is clamped to [-5, 10]
    critics' targets <- tau online + (1 - tau) target

Deployed is the action of greatest Q_1 among 100 of the actor. The warm-up of 40,000 of a million
updates becomes the same fraction of the budget. Kernel and sigma are the port's for most tasks
(Laplacian, 20); ``kernel=gaussian`` gives exp(-|u - v|_2^2 / (2 sigma)).

Deviations: the actor's loss is computed after the critics' step (the port's order cannot run on
today's PyTorch). The VAE's samples are clamped to +-``raw_limit`` before the kernel: logged actions
on a bound drive them towards infinity, where MMD would measure nothing but the distance between two
saturated actions. With four samples a side MMD does not reach the threshold even for equal
distributions where the log explores much (about 0.19 for uniform actions), so alpha rises towards
its cap there; that is the port's behaviour. Frames are standardised. The end of a logged trajectory
is a time-out and is bootstrapped through. gamma and the budget of 10,000 updates are the thesis's
(5.1.2).
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal

import torch
from torch import Tensor

from components.algorithms.parts.algorithm import Algorithm, per_transition
from components.algorithms.parts.learner import (
    LearnerInputs,
    Scalars,
    adam_each,
    bootstrapped,
    descend,
    needed,
    saturation,
)
from components.algorithms.parts.ranges import check_at_least_one, check_bootstrapping
from components.core.draws import Normal
from components.core.random_streams import LaneStreams
from components.data.batches import Batch
from components.networks import (
    Critics,
    TanhGaussian,
    lanewise_mean,
    polyak_update,
    soft_clipped_maximum,
)
from components.networks.variational import ConditionalVAE
from components.policies.policy import Policy, PolicyCard
from components.training.stacked_learner import StackedLearner

__all__ = [
    "ALGORITHM",
    "Config",
    "Learner",
    "mean_discrepancy",
]

LOG_MULTIPLIER_RANGE = (-5.0, 10.0)


@dataclass(frozen=True, kw_only=True)
class Config:
    """The recommended port's settings, with the thesis's discount and budget."""

    updates: int = 10_000
    hidden: tuple[int, ...] = (256, 256)  # layers of actor and critics
    vae_hidden: tuple[int, ...] = (750, 750)  # layers of encoder and decoder
    actor_learning_rate: float = 1e-4  # Adam
    learning_rate: float = 3e-4  # Adam, critics and VAE
    multiplier_learning_rate: float = 1e-3  # Adam, of log alpha
    batch: int = 256  # transitions per update
    discount: float = 0.97  # gamma
    target_rate: float = 0.005  # tau
    warm_up: float = 0.04  # first share of the updates, in which the actor only matches the log
    threshold: float = 0.05  # of MMD
    kernel: Literal["laplacian", "gaussian"] = "laplacian"
    sigma: float = 20.0  # width of the kernel
    matched_actions: int = 4  # samples of each side in MMD
    minimum_weight: float = 0.75  # of the least critic in targets, against the greatest
    target_actions: int = 10  # per next state
    deployed_actions: int = 100  # per state, when the policy acts
    raw_limit: float = 4.0  # of the VAE's samples before the tanh; tanh(4) = 0.9993

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "batch", "hidden", "vae_hidden")
        check_at_least_one(self, "matched_actions", "target_actions", "deployed_actions")
        check_bootstrapping(self.discount, self.target_rate)
        rates = (self.actor_learning_rate, self.learning_rate, self.multiplier_learning_rate)
        if min(*rates, self.sigma, self.threshold, self.raw_limit) <= 0:
            raise ValueError("learning rates, sigma, threshold and raw_limit must be positive.")
        if not 0 <= self.warm_up <= 1 or not 0 <= self.minimum_weight <= 1:
            raise ValueError("warm_up and minimum_weight must lie in [0, 1].")
        if self.kernel not in ("laplacian", "gaussian"):
            raise ValueError(f"kernel must be laplacian or gaussian, got {self.kernel!r}.")


def mean_discrepancy(x: Tensor, y: Tensor, kernel: str, sigma: float) -> Tensor:
    """Maximum mean discrepancy of two samples at every state.

    Args:
        x: ``[L, B, N, A]``.
        y: ``[L, B, M, A]``.
        kernel: ``laplacian`` or ``gaussian``.
        sigma: Width; distances are divided by twice it.

    Returns:
        ``[L, B]``; the diagonal pairs count, and 1e-6 keeps the root differentiable at 0.
    """

    def mean_kernel(u: Tensor, v: Tensor) -> Tensor:
        if kernel == "laplacian":
            apart = torch.cdist(u, v, p=1.0)
        else:
            apart = (u[:, :, :, None] - v[:, :, None]).square().sum(dim=-1)
        return torch.exp(apart * (-0.5 / sigma)).mean(dim=(2, 3))

    squared = mean_kernel(x, x) + mean_kernel(y, y) - 2.0 * mean_kernel(x, y)
    return torch.relu(squared + 1e-6).sqrt()


class Learner(StackedLearner):
    """A stack of BEAR learners, one lane per (dataset, seed)."""

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._config, self._data = config, inputs.data
        data, device, keys = inputs.data, inputs.data.device, inputs.keys
        self.lanes = data.lanes
        seen, acted = data.observation_width, data.action_width
        self._vae = ConditionalVAE(keys, seen, acted, config.vae_hidden).to(device)
        self._actor = TanhGaussian(keys, "actor", (seen, *config.hidden, acted)).to(device)
        self._critics = Critics(keys, seen, acted, config.hidden).to(device)
        self._critics_target = copy.deepcopy(self._critics).requires_grad_(False)
        self._log_multiplier = Scalars(self.lanes, 0.0).to(device)
        self._networks = {
            "vae": self._vae,
            "actor": self._actor,
            "critics": self._critics,
            "critics_target": self._critics_target,
            "log_multiplier": self._log_multiplier,
        }
        rates = {
            "vae": config.learning_rate,
            "critics": config.learning_rate,
            "actor": config.actor_learning_rate,
            "log_multiplier": config.multiplier_learning_rate,
        }
        self._optimizers = adam_each(self._networks, rates)
        latent, batch, matched = self._vae.latent, config.batch, config.matched_actions
        self._streams = LaneStreams(
            keys,
            {
                "row": data.row_draw(batch),
                "vae": Normal(batch, latent),
                "target": Normal(batch, config.target_actions, acted),
                "generated": Normal(batch, matched, latent),
                "actor": Normal(batch, matched, acted),
            },
            device,
        )

    # -- networks ---------------------------------------------------------------------------

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        candidates, _ = self._actor.sample(self._actor(observations), needed(noise, "noise"))
        return self._critics.best_action(observations, candidates)

    # -- losses -----------------------------------------------------------------------------

    @torch.no_grad()
    def _targets(self, batch: Batch, noise: Tensor) -> Tensor:
        """Bootstrapped values ``[L, B]`` of the logged transitions."""
        config, following = self._config, batch.next_observations
        actions, _ = self._actor.sample(self._actor(following), noise)
        values = self._critics_target.over_actions(following, actions)
        best = soft_clipped_maximum(values, config.minimum_weight)
        return bootstrapped(batch, config.discount, best)

    def _actor_loss(
        self, batch: Batch, drawn: dict[str, Tensor], step: int
    ) -> tuple[Tensor, Tensor, dict[str, Tensor]]:
        """Actor's loss, mean MMD, ``[L]`` each, and metrics."""
        config, limit = self._config, self._config.raw_limit
        with torch.no_grad():
            logged = self._vae.generate(batch.observations, drawn["generated"])
        actions, raw = self._actor.sample(self._actor(batch.observations), drawn["actor"])
        discrepancy = lanewise_mean(
            mean_discrepancy(logged.clamp(-limit, limit), raw, config.kernel, config.sigma)
        )
        multiplier = self._log_multiplier.value.detach().exp()
        loss = multiplier * (discrepancy - config.threshold)
        metrics = {
            "actor/discrepancy": discrepancy.detach(),
            "actor/multiplier": multiplier,
            "actor/saturated_share": saturation(actions),
        }
        if self.branch(step):
            values = self._critics.least(batch.observations, actions[:, :, 0])
            loss = loss - lanewise_mean(values)
            metrics["critic/value_magnitude"] = lanewise_mean(values.detach().abs())
        return loss, discrepancy.detach(), metrics | {"actor/loss": loss.detach()}

    # -- update -----------------------------------------------------------------------------

    def branch(self, step: int) -> bool:
        """Whether the warm-up is over, so that the actor's loss contains the values."""
        return step >= round(self._config.warm_up * self._config.updates)

    def update(self, step: int) -> dict[str, Tensor]:
        """One update of VAE, critics, actor, multiplier and targets on all lanes."""
        config, drawn = self._config, self._streams.at(step)
        batch = self._data.batch(drawn["row"])
        vae_loss, error, divergence = self._vae.losses(
            batch.observations, batch.actions, drawn["vae"]
        )
        descend(self._optimizers["vae"], vae_loss)
        targets = self._targets(batch, drawn["target"])
        critic_loss = self._critics.errors(batch.observations, batch.actions, targets).sum(dim=1)
        descend(self._optimizers["critics"], critic_loss)
        actor_loss, discrepancy, metrics = self._actor_loss(batch, drawn, step)
        descend(self._optimizers["actor"], actor_loss)
        log_multiplier = self._log_multiplier.value
        ascent = -log_multiplier.exp() * (discrepancy - config.threshold)
        descend(self._optimizers["log_multiplier"], ascent)
        with torch.no_grad():
            log_multiplier.clamp_(*LOG_MULTIPLIER_RANGE)
        polyak_update([(self._critics_target, self._critics)], config.target_rate)
        return metrics | {
            "critic/loss": critic_loss.detach(),
            "critic/target_mean": lanewise_mean(targets),
            "vae/reconstruction_error": error.detach(),
            "vae/divergence": divergence.detach(),
        }

    # -- what is deployed ---------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        acts = replace(
            card,
            kind="gaussian_candidates",
            candidates=self._config.deployed_actions,
            noise=self._data.action_width,
        )
        networks: dict[str, Sequence[tuple[Tensor, Tensor]]] = {
            "actor": self._actor.stack.affine(),
            "critic": self._critics.first_network(),
        }
        return Policy.of_networks(acts, networks, self._data.frame_scaling)


ALGORITHM: Final = Algorithm(
    name="bear",
    config=Config,
    learner=Learner,
    version=2,
    cost=per_transition(1.7e-4),
    frame_epsilon=1e-3,
)

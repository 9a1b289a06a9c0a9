"""BCQ: batch-constrained Q-learning, which chooses among actions that resemble the logged ones.

Fujimoto, Meger, Precup, "Off-Policy Deep Reinforcement Learning without Exploration" (2019). A
conditional VAE generates actions ``G(s)`` like the logged ones, a network ``xi`` perturbs each by
at most ``Phi``, and the value function picks the best. Per update, on one batch:

    VAE:     mean (D(s, z) - a)^2 + KL / 2, both averaged over batch and dimensions
    a'_i     = clip(G_i(s') + Phi tanh xi_target(s', G_i(s'))),  i = 1..10
    y        = r + gamma (1 - terminal) max_i [0.75 min_j Q_target_j(s', a'_i) + 0.25 max_j ...]
    critics: sum_j mean (Q_j(s, a) - y)^2
    xi:      -mean Q_1(s, G(s) + Phi tanh xi(s, G(s))), one generated action per state
    targets of critics and xi <- tau online + (1 - tau) target

Deployed is the action of greatest Q_1 among 100 perturbed generated ones. Where references disagree
the authors' current code is followed: 10 actions in targets and 100 at deployment (10 at the time
of the paper), KL averaged over latents (a quarter of the usual weight), log standard deviation of
the latents in [-4, 15], latents clamped to +-0.5 when actions are generated.

Deviations: frames are standardised (the authors' tasks have unit scale). The end of a logged
trajectory is a time-out and is bootstrapped through. gamma and the budget of 10,000 updates are the
thesis's (5.1.2).
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import torch
from torch import Tensor
from torch.nn.functional import hardtanh

from components.algorithms.parts.algorithm import Algorithm, per_transition
from components.algorithms.parts.learner import (
    LearnerInputs,
    adam_each,
    bootstrapped,
    descend,
    needed,
    saturation,
)
from components.algorithms.parts.ranges import check_at_least_one, check_bootstrapping
from components.core.draws import Normal
from components.core.random_streams import LaneStreams, spawn_generators
from components.data.batches import Batch
from components.networks import (
    Critics,
    StackedMLP,
    lanewise_mean,
    polyak_update,
    soft_clipped_maximum,
)
from components.networks.variational import ConditionalVAE
from components.policies.policy import Policy, PolicyCard
from components.training.stacked_learner import StackedLearner

__all__ = ["ALGORITHM", "Config", "Learner"]


@dataclass(frozen=True, kw_only=True)
class Config:
    """The authors' settings, with the thesis's discount and budget."""

    updates: int = 10_000
    hidden: tuple[int, ...] = (400, 300)  # layers of critics and perturbation
    vae_hidden: tuple[int, ...] = (750, 750)  # layers of encoder and decoder
    learning_rate: float = 1e-3  # Adam, all networks
    batch: int = 100  # transitions per update
    discount: float = 0.97  # gamma
    target_rate: float = 0.005  # tau
    perturbation: float = 0.05  # Phi, largest change of a generated action
    minimum_weight: float = 0.75  # of the least critic in targets, against the greatest
    target_actions: int = 10  # per next state
    deployed_actions: int = 100  # per state, when the policy acts

    def __post_init__(self) -> None:
        """Reject values outside their range.

        Raises:
            ValueError: Naming the fields and their range.
        """
        check_at_least_one(self, "updates", "batch", "hidden", "vae_hidden")
        check_at_least_one(self, "target_actions", "deployed_actions")
        check_bootstrapping(self.discount, self.target_rate)
        if self.learning_rate <= 0 or self.perturbation < 0 or not 0 <= self.minimum_weight <= 1:
            raise ValueError(
                "learning_rate must be positive, perturbation not negative and minimum_weight "
                "lie in [0, 1]."
            )


class Learner(StackedLearner):
    """A stack of BCQ learners, one lane per (dataset, seed)."""

    def __init__(self, config: Config, inputs: LearnerInputs) -> None:
        self._config, self._data = config, inputs.data
        data, device, keys = inputs.data, inputs.data.device, inputs.keys
        self.lanes = data.lanes
        seen, acted = data.observation_width, data.action_width
        self._vae = ConditionalVAE(keys, seen, acted, config.vae_hidden).to(device)
        self._actor = StackedMLP(
            spawn_generators(keys, "actor"), (seen + acted, *config.hidden, acted)
        ).to(device)
        self._critics = Critics(keys, seen, acted, config.hidden).to(device)
        self._actor_target = copy.deepcopy(self._actor).requires_grad_(False)
        self._critics_target = copy.deepcopy(self._critics).requires_grad_(False)
        self._networks = {
            "vae": self._vae,
            "actor": self._actor,
            "critics": self._critics,
            "actor_target": self._actor_target,
            "critics_target": self._critics_target,
        }
        learned = ("vae", "actor", "critics")
        self._optimizers = adam_each(self._networks, dict.fromkeys(learned, config.learning_rate))
        latent = self._vae.latent
        self._streams = LaneStreams(
            keys,
            {
                "row": data.row_draw(config.batch),
                "vae": Normal(config.batch, latent),
                "target": Normal(config.batch, config.target_actions, latent),
                "actor": Normal(config.batch, 1, latent),
            },
            device,
        )

    # -- networks ---------------------------------------------------------------------------

    def _perturb(self, actor: StackedMLP, observations: Tensor, generated: Tensor) -> Tensor:
        """Perturbed actions ``[L, B, N, A]``."""
        shift = torch.tanh(actor.over_actions(observations, generated))
        return hardtanh(torch.add(generated, shift, alpha=self._config.perturbation))

    @torch.no_grad()
    def _generate(self, observations: Tensor, noise: Tensor) -> Tensor:
        """Actions like the logged ones, ``[L, B, N, A]``."""
        return torch.tanh(self._vae.generate(observations, noise))

    def act(
        self, observations: Tensor, proximity: Tensor | None = None, noise: Tensor | None = None
    ) -> Tensor:
        """Actions of the current policies, see :class:`.PolicyLearner`."""
        generated = self._generate(observations, needed(noise, "noise"))
        return self._critics.best_action(
            observations, self._perturb(self._actor, observations, generated)
        )

    # -- losses -----------------------------------------------------------------------------

    @torch.no_grad()
    def _targets(self, batch: Batch, noise: Tensor) -> Tensor:
        """Bootstrapped values ``[L, B]`` of the logged transitions."""
        config, following = self._config, batch.next_observations
        actions = self._perturb(self._actor_target, following, self._generate(following, noise))
        values = self._critics_target.over_actions(following, actions)
        best = soft_clipped_maximum(values, config.minimum_weight)
        return bootstrapped(batch, config.discount, best)

    def _actor_loss(self, batch: Batch, noise: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        generated = self._generate(batch.observations, noise)
        actions = self._perturb(self._actor, batch.observations, generated).squeeze(2)
        values = self._critics.first(batch.observations, actions)
        loss = -lanewise_mean(values)
        return loss, {
            "actor/loss": loss.detach(),
            "actor/saturated_share": saturation(actions),
            "critic/value_magnitude": lanewise_mean(values.detach().abs()),
        }

    # -- update -----------------------------------------------------------------------------

    def update(self, step: int) -> dict[str, Tensor]:
        """One update of VAE, critics, perturbation and targets on all lanes."""
        drawn = self._streams.at(step)
        batch = self._data.batch(drawn["row"])
        vae_loss, error, divergence = self._vae.losses(
            batch.observations, batch.actions, drawn["vae"]
        )
        descend(self._optimizers["vae"], vae_loss)
        targets = self._targets(batch, drawn["target"])
        critic_loss = self._critics.errors(batch.observations, batch.actions, targets).sum(dim=1)
        descend(self._optimizers["critics"], critic_loss)
        actor_loss, metrics = self._actor_loss(batch, drawn["actor"])
        descend(self._optimizers["actor"], actor_loss)
        moving = [(self._actor_target, self._actor), (self._critics_target, self._critics)]
        polyak_update(moving, self._config.target_rate)
        return metrics | {
            "critic/loss": critic_loss.detach(),
            "critic/target_mean": lanewise_mean(targets),
            "vae/reconstruction_error": error.detach(),
            "vae/divergence": divergence.detach(),
        }

    # -- what is deployed ---------------------------------------------------------------------

    def policy(self, card: PolicyCard) -> Policy:
        """The current policies, one per lane."""
        config = self._config
        acts = replace(
            card,
            kind="perturbed_candidates",
            candidates=config.deployed_actions,
            noise=self._vae.latent,
            perturbation=config.perturbation,
        )
        networks: dict[str, Sequence[tuple[Tensor, Tensor]]] = {
            "actor": self._actor.affine(),
            "decoder": self._vae.decoder.affine(),
            "critic": self._critics.first_network(),
        }
        return Policy.of_networks(acts, networks, self._data.frame_scaling)


ALGORITHM: Final = Algorithm(
    name="bcq",
    config=Config,
    learner=Learner,
    version=2,
    cost=per_transition(3.3e-4),
    frame_epsilon=1e-3,
)

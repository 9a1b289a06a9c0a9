"""A small linear machine, its logs, and hand-made models: what the tests of the learners share.

The machine is shaped like the Industrial Benchmark; the models fit any log, see also
:mod:`tests.components.robot`.
"""

import dataclasses
import itertools
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from components.core.normaliser import Normaliser
from components.core.random_streams import lane_generator, lane_key
from components.data.card import DatasetCard
from components.data.dataset import OfflineDataset, array_digest
from components.data.dynamics import DynamicsSpecification, model_frames
from components.models.action_vae import ActionVAE
from components.models.mlp_ensemble.ensemble import MLPEnsemble
from components.models.recurrent_ensemble.ensemble import (
    Feedback,
    RecurrentEnsemble,
    RecurrentEnsembleConfig,
)
from components.networks import StackedMLP
from components.networks.variational import ConditionalVAE
from components.policies.policy import Policy, PolicyCard

CPU = torch.device("cpu")
FEATURES = ("setpoint", "velocity", "gain", "shift", "fatigue", "consumption")
SCALE = np.array([1.0, 10.0, 5.75])
FATIGUE_ALONE = Feedback.stored(torch.tensor([[1.0], [0.0]]), torch.zeros(2, 1))
GAINS = np.array([[-0.8, 0.2, 0.0], [0.1, -0.6, 0.3], [0.3, 0.0, -0.5]])


def controller(steerings: np.ndarray) -> np.ndarray:
    """The operator of the small machine: saturated linear feedback, ``[N, 3]`` to ``[N, 3]``."""
    return np.tanh((steerings - 50.0) / 15.0 @ GAINS.T)


def next_outputs(steerings: np.ndarray, fatigue: np.ndarray) -> np.ndarray:
    """Fatigue and consumption ``[N, 2]`` after the steerings have moved."""
    velocity, gain, shift = steerings.T
    worn = 0.6 * fatigue + 0.2 * velocity + 0.1 * shift
    return np.stack([worn, 20.0 + 0.5 * gain + 0.8 * velocity - 0.3 * shift], axis=1)


def make_log(
    name: str = "toy",
    *,
    seed: int = 0,
    episodes: int = 6,
    steps: int = 40,
    history: int = 3,
    explore: float = 0.5,
    discount: float = 0.97,
) -> OfflineDataset:
    """Log the small machine; with chance ``explore`` a step's action is uniform."""
    rng = np.random.default_rng(seed)
    frames = np.empty((episodes, steps + 1, len(FEATURES)))
    actions = np.empty((episodes, steps, 3))
    steerings = rng.uniform(20.0, 80.0, (episodes, 3))
    outputs = next_outputs(steerings, np.full(episodes, 30.0))
    for t in range(steps + 1):
        frames[:, t] = np.column_stack([np.full(episodes, 70.0), steerings, outputs])
        if t == steps:
            break
        action = controller(steerings)
        random = rng.random(episodes) < explore
        action[random] = rng.uniform(-1.0, 1.0, (int(random.sum()), 3))
        actions[:, t] = action
        steerings = np.clip(steerings + SCALE * action, 0.0, 100.0)
        outputs = next_outputs(steerings, outputs[:, 0])
    rewards = -0.03 * frames[:, 1:, 4] - 0.01 * frames[:, 1:, 5]
    truncated = np.zeros((episodes, steps), dtype=np.bool_)
    truncated[:, -1] = True
    card = DatasetCard(
        name=name,
        environment="none",
        environment_parameters={},
        controller="linear",
        epsilon=explore,
        seed=seed,
        trajectories=episodes,
        steps=steps,
        transitions=episodes * steps,
        discount=discount,
        history=history,
        frame_features=FEATURES,
        action_features=("velocity", "gain", "shift"),
        dynamics={
            "known": {
                "features": list(FEATURES[:4]),
                "keep": [1.0] * 3,
                "scale": SCALE.tolist(),
                "low": 0.0,
                "high": 100.0,
            },
            "learned": list(FEATURES[4:]),
            "reward": {"fatigue": -0.03, "consumption": -0.01},
        },
        return_steps=steps,
        first_window_return_mean=-60.0,
        first_window_return_min=-61.0,
        first_window_return_max=-59.0,
        all_windows_return_mean=-50.0,
        digest="",
    )
    return relabelled(
        OfflineDataset(
            card=card,
            frames=frames.reshape(-1, len(FEATURES)).astype(np.float32),
            actions=actions.reshape(-1, 3).astype(np.float32),
            rewards=rewards.reshape(-1).astype(np.float32),
            terminated=np.zeros(episodes * steps, dtype=np.bool_),
            truncated=truncated.reshape(-1),
            episode_starts=np.arange(episodes + 1, dtype=np.int64) * steps,
        )
    )


def relabelled(dataset: OfflineDataset, **arrays: np.ndarray) -> OfflineDataset:
    """The dataset with some arrays replaced, and the digest that belongs to them."""
    changed = dataclasses.replace(dataset, **arrays)
    card = dataclasses.replace(changed.card, digest=array_digest(changed.arrays()))
    return dataclasses.replace(changed, card=card)


def keys(*names: object) -> list[int]:
    """One stream key per name."""
    return [lane_key("test", name) for name in names]


def policy_card(dataset: OfflineDataset | None = None, **changes: object) -> PolicyCard:
    """A card that fits a dataset's frames, or those of the small machine."""
    fields = {
        "algorithm": "test",
        "dataset": "toy" if dataset is None else dataset.card.name,
        "features": FEATURES if dataset is None else dataset.card.frame_features,
        "history": 3 if dataset is None else dataset.card.history,
        "actions": 3 if dataset is None else len(dataset.card.action_features),
        "takes_proximity": False,
        "steps": (1,),
    }
    return PolicyCard(**(fields | changes))


def random_policy(dataset: OfflineDataset, names: Sequence[object], hidden: int = 8) -> Policy:
    """One random policy per name, scaled with the statistics of the dataset."""
    width, actions = dataset.card.history * dataset.frames.shape[1], dataset.actions.shape[1]
    network = StackedMLP([lane_generator(key) for key in keys(*names)], (width, hidden, actions))
    scaling = Normaliser.fit(dataset.frames)
    card = policy_card(dataset, steps=tuple(range(len(names))))
    return Policy.of_networks(
        card, {"actor": network.affine()}, Normaliser.stack([scaling] * len(names))
    )


def constant_policy(
    actions: Sequence[float], features: tuple[str, ...] = FEATURES, history: int = 3
) -> Policy:
    """A policy that always acts in the same way."""
    weight = torch.zeros(1, len(features) * history, len(actions))
    bias = torch.atanh(torch.tensor(actions)).view(1, 1, -1)
    scaling = Normaliser(torch.zeros(1, len(features)), torch.ones(1, len(features)))
    card = policy_card(features=features, history=history, actions=len(actions))
    return Policy.of_networks(card, {"actor": [(weight, bias)]}, scaling)


def machine_scaling(dataset: OfflineDataset) -> tuple[DynamicsSpecification, Normaliser, Tensor]:
    """What its card says, the scaling of its machine frames, and their normalised targets."""
    rule = DynamicsSpecification.of_card(dataset.card)
    frames = model_frames(dataset, rule)
    scaling = Normaliser.fit(frames)
    return rule, scaling, scaling.apply(torch.from_numpy(frames))[:, len(rule.known) :]


def random_ensemble(
    dataset: OfflineDataset, name: object, members: int = 3, hidden: int = 5
) -> RecurrentEnsemble:
    """An untrained ensemble with visible differences between its members.

    On the small machine networks predict values of one target each, on a robot changes of all.
    """
    rng = lane_generator(lane_key("ensemble", name))
    rule, scaling, scaled = machine_scaling(dataset)
    form = {"networks": "joint", "target": "change"} if rule.hides else {}
    feedback = Feedback.of(RecurrentEnsembleConfig(**form), rule)
    groups, looped = feedback.reads.shape
    columns = hidden + len(rule.known) + looped + 1
    shapes = (
        (members * groups, hidden, columns),
        (
            members * groups,
            len(rule.learned) // groups,
            hidden + 1,
        ),
    )
    weight = torch.from_numpy(rng.normal(0.0, 0.5, shapes[0])).float()
    reads = feedback.reads.repeat_interleave(members, dim=0)[:, None]
    weight[:, :, -1 - looped : -1] *= reads
    return RecurrentEnsemble(
        weight,
        torch.from_numpy(rng.normal(0.0, 0.2 if rule.hides else 0.6, shapes[1])).float(),
        scaling,
        scaled.amin(dim=0),
        scaled.amax(dim=0),
        feedback,
        warm_up=3,
    )


def random_mlp_ensemble(
    dataset: OfflineDataset, name: object, members: int = 3, gaussian: bool = False
) -> MLPEnsemble:
    """An untrained ensemble of one-step models of changes, with visible differences."""
    rng = lane_generator(lane_key("mlp", name))
    rule, scaling, scaled = machine_scaling(dataset)
    targets = len(rule.learned)
    inputs = dataset.card.history * dataset.frames.shape[1] + len(rule.known)
    layers = [
        (
            torch.from_numpy(rng.normal(0.0, inputs**-0.5, (members, inputs, outputs))).float(),
            torch.from_numpy(rng.normal(0.0, 0.3, (members, 1, outputs))).float(),
        )
        for inputs, outputs in itertools.pairwise((inputs, 5, targets * (2 if gaussian else 1)))
    ]
    bounds = torch.tensor([[-6.0], [0.5]]).expand(members, 2, targets).clone()
    return MLPEnsemble(
        layers=tuple(layers),
        frames=scaling,
        observed=rule.observed,
        low=scaled.amin(dim=0),
        high=scaled.amax(dim=0),
        target_mean=torch.linspace(0.01, -0.02, targets),
        target_scale=torch.linspace(0.3, 0.4, targets),
        log_variance=bounds if gaussian else torch.empty(0),
        history=dataset.card.history,
        activation="swish" if gaussian else "relu",
        target="change",
        elites=tuple(range(1, members)) if gaussian else tuple(range(members)),
    )


def random_action_vae(dataset: OfflineDataset, name: object) -> ActionVAE:
    """An untrained autoencoder that reads at most two frames, in a scaling of its own."""
    fitted, history = Normaliser.fit(dataset.frames), min(2, dataset.card.history)
    own = Normaliser(fitted.mean + 3.0, 1.5 * fitted.scale)
    width, actions = history * dataset.frames.shape[1], dataset.actions.shape[1]
    network = ConditionalVAE([lane_key("vae", name)], width, actions, (7, 6))
    return ActionVAE(network.requires_grad_(False), own, history, (7, 6))


def random_model(model: str, dataset: OfflineDataset) -> Any:
    """An untrained model of a name in the registry, always the same for a dataset."""
    name = dataset.card.name
    if model == "behaviour_policy":
        return random_policy(dataset, (name,))
    if model == "recurrent_ensemble":
        return random_ensemble(dataset, name)
    if model in ("deterministic_ensemble", "gaussian_ensemble", "residual_ensemble"):
        return random_mlp_ensemble(dataset, (model, name), gaussian=model == "gaussian_ensemble")
    if model == "action_vae":
        return random_action_vae(dataset, name)
    raise KeyError(model)

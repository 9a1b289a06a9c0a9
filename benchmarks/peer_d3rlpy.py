"""d3rlpy's side of `benchmarks.model_free`, run by an interpreter that has d3rlpy.

`python -I benchmarks/peer_d3rlpy.py DATA.npz SETTINGS [--threads 2] [--updates 100]`. d3rlpy pins a
Gymnasium older than this project's, so the two cannot share an environment: nothing of this project
is imported here, and d3rlpy only where it is used, so that the settings can be read without it.

A step does what one step of d3rlpy's `fit` does without its logger and progress bar: sample a batch
from the replay buffer and update. Its algorithms get our sizes, rates and counts, and fixed ones
where ours have none: BEAR no warm-up and no entropy bonus, CQL no learned multiplier. The last line
of the standard output is the answer as JSON: seconds, updates and versions.
"""

import argparse
import json
import statistics
import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
import torch

__all__ = ["COUNTERPARTS", "Counterpart", "arguments", "layers"]


@dataclass(frozen=True, kw_only=True)
class Counterpart:
    """An algorithm of d3rlpy, and how it is told our settings.

    Attributes:
        name: Of d3rlpy's algorithm.
        settings: Its arguments -> names of our settings.
        layers: Its networks -> names of our settings with their hidden widths.
        fixed: Its arguments for which ours have no setting.
    """

    name: str
    settings: Mapping[str, str]
    layers: Mapping[str, str]
    fixed: Mapping[str, float] = field(default_factory=dict)


_SETTINGS = {
    "batch_size": "batch",
    "gamma": "discount",
    "tau": "target_rate",
    "actor_learning_rate": "learning_rate",
    "critic_learning_rate": "learning_rate",
}
_LAYERS = {"actor": "hidden", "critic": "hidden"}
_WITH_VAE = {**_LAYERS, "imitator": "vae_hidden"}

COUNTERPARTS: Mapping[str, Counterpart] = MappingProxyType(
    {
        "ddpg": Counterpart(name="DDPG", settings=_SETTINGS, layers=_LAYERS),
        "bcq": Counterpart(
            name="BCQ",
            settings=_SETTINGS
            | {
                "imitator_learning_rate": "learning_rate",
                "action_flexibility": "perturbation",
                "lam": "minimum_weight",
                "n_action_samples": "target_actions",
            },
            layers=_WITH_VAE,
        ),
        "bear": Counterpart(
            name="BEAR",
            settings=_SETTINGS
            | {
                "actor_learning_rate": "actor_learning_rate",
                "imitator_learning_rate": "learning_rate",
                "alpha_learning_rate": "multiplier_learning_rate",
                "alpha_threshold": "threshold",
                "lam": "minimum_weight",
                "n_action_samples": "deployed_actions",
                "n_target_samples": "target_actions",
                "n_mmd_action_samples": "matched_actions",
                "mmd_kernel": "kernel",
                "mmd_sigma": "sigma",
            },
            layers=_WITH_VAE,
            fixed={"warmup_steps": 0, "temp_learning_rate": 0.0, "initial_temperature": 1e-20},
        ),
        "cql": Counterpart(
            name="CQL",
            settings=_SETTINGS
            | {
                "actor_learning_rate": "actor_learning_rate",
                "temp_learning_rate": "actor_learning_rate",
                "conservative_weight": "weight",
                "n_action_samples": "tried_actions",
            },
            layers=_LAYERS,
            fixed={"alpha_learning_rate": 0.0},
        ),
        "td3_bc": Counterpart(
            name="TD3PlusBC",
            settings=_SETTINGS
            | {
                "alpha": "alpha",
                "target_smoothing_sigma": "smoothing",
                "target_smoothing_clip": "smoothing_clip",
                "update_actor_interval": "actor_every",
            },
            layers=_LAYERS,
        ),
    }
)


def arguments(algorithm: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments of d3rlpy's configuration, except for the networks."""
    peer = COUNTERPARTS[algorithm]
    return {theirs: settings[ours] for theirs, ours in peer.settings.items()} | dict(peer.fixed)


def layers(algorithm: str, settings: Mapping[str, Any]) -> dict[str, list[int]]:
    """Hidden widths of d3rlpy's networks."""
    peer = COUNTERPARTS[algorithm]
    return {network: list(settings[ours]) for network, ours in peer.layers.items()}


def _replay_buffer(path: Path) -> Any:
    """Transitions from `observations [N, O]`, `actions [N, A]`, and, `[N]` each, `rewards`,
    `terminals` and `ends`; the latter are true where an episode ends, for whatever reason."""
    from d3rlpy.dataset import MDPDataset

    with np.load(path, allow_pickle=False) as data:
        terminals = data["terminals"].astype(np.float32)
        return MDPDataset(
            observations=data["observations"],
            actions=data["actions"],
            rewards=data["rewards"],
            terminals=terminals,
            timeouts=data["ends"].astype(np.float32) * (1.0 - terminals),
        )


def _learner(settings: Mapping[str, Any], buffer: Any) -> Any:
    """A fresh learner on the CPU; `settings` holds the name of ours as `algorithm`."""
    from d3rlpy import algos
    from d3rlpy.models.encoders import VectorEncoderFactory

    name = settings["algorithm"]
    networks = {
        f"{network}_encoder_factory": VectorEncoderFactory(hidden_units=widths)
        for network, widths in layers(name, settings).items()
    }
    configuration = getattr(algos, f"{COUNTERPARTS[name].name}Config")
    learner = configuration(**arguments(name, settings), **networks).create(device="cpu:0")
    learner.build_with_dataset(buffer)
    return learner


def _seconds(learner: Any, buffer: Any, updates: int) -> float:
    begin = time.perf_counter()
    for _ in range(updates):
        learner.update(buffer.sample_transition_batch(learner.batch_size))
    return time.perf_counter() - begin


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("settings", type=json.loads, help="JSON: algorithm and its settings")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--updates", type=int, default=100)
    parser.add_argument("--repetitions", type=int, default=1, help="timings, of as many updates")
    parser.add_argument("--warm-up", type=int, default=10, help="updates that do not count")
    options = parser.parse_args()
    import d3rlpy

    torch.set_num_threads(options.threads)
    d3rlpy.seed(0)
    buffer = _replay_buffer(options.data)
    learner = _learner(options.settings, buffer)
    _seconds(learner, buffer, options.warm_up)
    timings = [_seconds(learner, buffer, options.updates) for _ in range(options.repetitions)]
    answer = {
        "seconds": statistics.median(timings),
        "timings": timings,
        "updates": options.updates,
        "program": f"d3rlpy {d3rlpy.__version__}",
        "torch": torch.__version__,
    }
    print(json.dumps(answer))


if __name__ == "__main__":
    main()

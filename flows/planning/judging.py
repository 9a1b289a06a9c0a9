"""The nodes that judge policies from their log alone: the log's two parts, judges, judgements."""

from collections.abc import Mapping
from dataclasses import asdict, replace
from typing import Any, Literal

from components.algorithms import ALGORITHMS
from components.data.sizes import weights
from components.data.sources.stored_log import StoredLog
from flows.configuration.schema import Settings
from flows.pipeline.plan import Node
from flows.planning.costs import data_sizes
from flows.planning.nodes import jsonable, model_node
from flows.planning.sizes import suits

__all__ = [
    "JUDGE_MODELS",
    "LEAST_EPISODES",
    "is_judged",
    "judge_models",
    "judgement_node",
    "part_node",
]

JUDGE_MODELS = ("behaviour_policy", "recurrent_ensemble")
"""What is fitted to the judges' part of a log; an ensemble only where the log suits it."""

_CRITIC, _ACTION = 2e-10, 6e-11
"""Core-seconds of a weight in an update of critics, for each transition, and when a policy acts."""

JUDGE_SEED = 1
"""Of the judges' fits; policies of all seeds share the fits of seed 0, unless each has its own."""

LEAST_EPISODES = 4
"""Of a log that is divided: both parts need two, since models hold out one."""


def is_judged(settings: Settings, dataset: str) -> bool:
    """Whether the policies of a dataset are judged from its log."""
    source, wanted = settings.dataset[dataset], settings.judging.policies
    if isinstance(source, StoredLog) and source.card.trajectories < LEAST_EPISODES:
        return False
    return wanted == "all" or (wanted == "auto" and source.environment is None)


def part_node(settings: Settings, data: Node, part: Literal["train", "judge"]) -> Node:
    """The node of a part of a log: the episodes that policies learn from, or those of judges."""
    dataset = data.tags["dataset"]
    return Node(
        component="data_split",
        name=f"data/{dataset}/{part}",
        task="flows.tasks.data_split:split_log",
        version=1,
        config={"part": part, "held_out": settings.judging.held_out},
        inputs={"dataset": data},
        tags={"dataset": dataset},
        cost=0.1 + 1e-7 * data_sizes(settings.dataset[dataset]).transitions,
    )


def judge_models(
    settings: Settings, whole: Node, configs: Mapping[tuple[str, str], Any]
) -> dict[str, Node]:
    """The judges' part of a log and the models that are fitted to it, by role.

    Args:
        settings: Of the run.
        whole: The node of the whole log.
        configs: Configuration objects of models by dataset and name.
    """
    dataset = whole.tags["dataset"]
    part, sizes = part_node(settings, whole, "judge"), data_sizes(settings.dataset[dataset])
    models = {
        name: model_node(name, configs[dataset, name], dataset, part, sizes, JUDGE_SEED)
        for name in JUDGE_MODELS
        if suits(settings, dataset, configs[dataset, name])
    }
    return {"dataset": part} | {
        name: replace(node, name=f"{node.name}/judge") for name, node in models.items()
    }


def judgement_node(
    settings: Settings, policy: Node, config: Any, judges: Mapping[str, Node]
) -> Node:
    """The node that judges the last snapshots of a run.

    Args:
        settings: Of the run.
        policy: The node of the run.
        config: The algorithm's configuration object.
        judges: What :func:`judge_models` returned.
    """
    dataset, estimates = policy.tags["dataset"], settings.judging.estimates
    sizes = data_sizes(settings.dataset[dataset])
    own = policy.inputs.get("recurrent_ensemble")
    takes = ALGORITHMS[policy.config["algorithm"]].takes_proximity
    snapshots = min(settings.judging.snapshots, settings.training.snapshots)
    policies = snapshots * (len(estimates.proximities) if takes else 1)
    return Node(
        component="judgement",
        name=f"judge/{policy.name}",
        task="flows.tasks.judging:judge_policies",
        version=2,
        config={"estimates": jsonable(asdict(estimates)), "snapshots": snapshots},
        inputs={"policy": policy, **judges} | ({"trained_in": own} if own else {}),
        tags=policy.tags,
        lanes=f"judge/{dataset}",
        cost=policies
        * (
            _CRITIC
            * estimates.updates
            * estimates.batch
            * estimates.replicas
            * weights(estimates, sizes)
            + _ACTION * sizes.transitions * weights(config, sizes)
        ),
    )

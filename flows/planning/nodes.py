"""One node per component run: what decides its result, what it reads, what it costs."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from components.algorithms import ALGORITHMS
from components.core.options import identity
from components.data.sizes import DataSizes
from components.data.sources.robots import RobotSpec
from components.data.sources.stored_log import StoredLog
from components.environments.systems import SYSTEMS
from components.models import MODELS
from flows.configuration.checking import SettingsError
from flows.configuration.schema import Settings
from flows.pipeline.plan import Node, digest
from flows.pipeline.source import code_digest
from flows.planning.costs import data_cost, data_sizes, evaluation_cost
from flows.planning.packing import evaluated_together, trained_together

__all__ = [
    "COMPONENTS",
    "Variant",
    "aggregation_node",
    "data_node",
    "evaluation_node",
    "jsonable",
    "model_node",
    "policy_node",
    "simulated_on",
    "variants",
]

COMPONENTS = {
    "data_generation": 2,
    "policy_training": 2,
    "evaluation": 2,
    "aggregation": 2,
}
"""The components and the versions of their code; raise one when its results change.

Model fitting has a version per kind of model, in :data:`components.models.MODELS`.
"""


def jsonable(value: Any) -> Any:
    """JSON-able copy: tuples become lists."""
    if isinstance(value, Mapping):
        return {str(k): jsonable(v) for k, v in value.items()}
    return [jsonable(v) for v in value] if isinstance(value, tuple | list) else value


def simulated_on(environment: str) -> dict[str, str]:
    """Name and version of a system's simulator, for configurations; empty if it has none."""
    simulator = SYSTEMS[environment].simulator()
    return {"simulator": simulator} if simulator else {}


@dataclass(frozen=True)
class Variant:
    """A configuration of an algorithm that the benchmark trains.

    Attributes:
        algorithm: Name of the algorithm.
        config: Its configuration object.
        label: Name in tables and run names; the algorithm's own where there is only one variant.
        tags: The setting that distinguishes it, by which trackers find it.
    """

    algorithm: str
    config: Any
    label: str
    tags: Mapping[str, str] = field(default_factory=dict)


def variants(settings: Settings, dataset: str, algorithm: str) -> list[Variant]:
    """The variants of an algorithm: one, or one for each different configuration that is wanted."""
    varied = settings.varied_on(dataset, algorithm)
    if not varied:
        return [Variant(algorithm, settings.algorithm_on(dataset, algorithm), algorithm)]
    found: list[Variant] = []
    for name, value, config in varied:
        shown = f"{value:g}" if isinstance(value, int | float) else str(value)
        if all(config != other.config for other in found):
            label = f"{algorithm}-{name}-{shown}"
            found.append(Variant(algorithm, config, label, {name: shown}))
    return found


def data_node(settings: Settings, name: str) -> Node:
    source = settings.dataset[name]
    try:
        made_with = dict(source.ingredients)
    except (FileNotFoundError, ValueError) as error:
        raise SettingsError(f"{name}: {error}") from error
    stored = isinstance(source, StoredLog)
    return Node(
        component="data_generation",
        name=f"data/{name}",
        task="flows.tasks.data_generation:generate_dataset",
        version=COMPONENTS["data_generation"],
        config={"spec": jsonable(source.identity), "seed": 0 if stored else settings.data.seed}
        | ({"ingredients": made_with} if made_with else {})
        | ({} if stored else simulated_on(source.environment)),
        folders={"log": str(source.folder)} if stored else {},
        tags={"dataset": name},
        cost=data_cost(source),
    )


def model_node(
    name: str,
    model: Any,
    dataset: str,
    data: Node,
    sizes: DataSizes,
    seed: int = 0,
    *,
    shared: bool = True,
    for_algorithm: str = "",
) -> Node:
    """The node that fits a model.

    Args:
        name: Of the model.
        model: Its configuration object.
        dataset: Name of the dataset.
        data: The dataset's node.
        sizes: The dataset's sizes, for the cost.
        seed: Of the fit. Models that all policies of a dataset share have seed 0.
        shared: Whether all policies share the fit; otherwise it belongs to those of this seed.
        for_algorithm: The algorithm for which alone these settings hold; empty for all.
    """
    return Node(
        component="model_fitting",
        name=f"{name}/{dataset}"
        + (f"/{for_algorithm}" if for_algorithm else "")
        + ("" if shared else f"/seed{seed}"),
        task="flows.tasks.model_fitting:fit_model",
        version=MODELS[name].version,
        config={"model": name, "settings": jsonable(identity(model)), "seed": seed},
        inputs={"dataset": data},
        tags={"dataset": dataset, "model": name} | ({} if shared else {"seed": str(seed)}),
        cost=MODELS[name].cost(model, sizes),
        code=code_digest([type(model).__module__, MODELS[name].fit.__module__]),
    )


def policy_node(
    settings: Settings, variant: Variant, dataset: str, seed: int, inputs: Mapping[str, Node]
) -> Node:
    algorithm, config = ALGORITHMS[variant.algorithm], variant.config
    # A stack has one configuration, and data and models of one shape.
    needs = algorithm.models_for(config)
    models = {role: inputs[role].config["settings"] for role in needs}
    source = settings.dataset[dataset]
    system = source.environment
    # A stored log may tell more about its system than the registry.
    stored = isinstance(source, StoredLog)
    dynamics = source.card.dynamics if stored else SYSTEMS[system].dynamics
    own = jsonable(identity(config))
    kind = digest([own, models, system], 4)
    return Node(
        component="policy_training",
        name=f"{variant.label}/{dataset}/seed{seed}",
        task="flows.tasks.policy_training:train",
        version=COMPONENTS["policy_training"],
        config={
            "algorithm": algorithm.name,
            "algorithm_version": algorithm.version_on(dynamics),
            "settings": own,
            "snapshots": settings.training.snapshots,
            "seed": seed,
        },
        inputs={role: inputs[role] for role in ("dataset", *needs)},
        tags={"dataset": dataset, "algorithm": algorithm.name, "seed": str(seed), **variant.tags},
        lanes=trained_together(settings, f"train/{algorithm.name}/{kind}", dataset, seed),
        cost=algorithm.cost(config, data_sizes(source)),
        code=code_digest([type(config).__module__, algorithm.learner.__module__]),
    )


def evaluation_node(settings: Settings, variant: Variant, policy: Node, behaviour: Node) -> Node:
    dataset, algorithm = policy.tags["dataset"], variant.algorithm
    spec = settings.dataset[dataset]
    protocol = settings.evaluation
    takes_proximity = ALGORITHMS[algorithm].takes_proximity
    proximities = len(protocol.proximities) if takes_proximity else 1
    return Node(
        component="evaluation",
        name=f"evaluate/{policy.name}",
        task="flows.tasks.evaluation:evaluate",
        version=COMPONENTS["evaluation"],
        config={
            "environment": spec.environment,
            "parameters": jsonable(spec.environment_parameters),
            "evaluation": protocol.record(spec.discount),
            "stream": [dataset, algorithm, policy.config["seed"]],
        }
        | simulated_on(spec.environment),
        inputs={"policy": policy, "behaviour_policy": behaviour},
        tags=policy.tags,
        lanes=evaluated_together(settings, variant.label, dataset, policy.config["seed"]),
        cost=evaluation_cost(
            variant.config,
            data_sizes(spec),
            settings.training.snapshots
            * proximities
            * protocol.trajectories
            * min(protocol.horizon, spec.steps),
            robot=isinstance(spec, RobotSpec),
        ),
    )


def aggregation_node(
    settings: Settings, variant: Variant, dataset: str, evaluations: Mapping[int, Node]
) -> Node:
    return Node(
        component="aggregation",
        name=f"aggregate/{variant.label}/{dataset}",
        task="flows.tasks.aggregation:aggregate",
        version=COMPONENTS["aggregation"],
        config={
            "dataset": dataset,
            "algorithm": variant.label,
            "seeds": sorted(evaluations),
            "pool_fraction": settings.aggregation.pool_fraction,
        },
        inputs={f"seed{seed}": node for seed, node in evaluations.items()},
        tags={"dataset": dataset, "algorithm": variant.algorithm, **variant.tags},
        cost=0.1,
    )

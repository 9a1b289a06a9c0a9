"""From settings to the plan of the benchmark: one node per component run."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from itertools import product
from typing import Any

from components.algorithms import ALGORITHMS
from components.data.dynamics import DynamicsSpecification
from components.data.sources.industrial import IndustrialSpec
from components.data.sources.robots import RobotSpec
from components.data.sources.source import DatasetSource
from components.data.sources.stored_log import StoredLog
from components.environments.systems import SYSTEMS
from components.models import MODELS
from components.models.mlp_ensemble.config import MLPEnsembleConfig
from components.models.recurrent_ensemble.ensemble import RecurrentEnsembleConfig
from flows.configuration.settings import Settings, SettingsError
from flows.pipeline.plan import Node, Plan, digest
from flows.planning.costs import data_cost
from flows.planning.model_choice import ModelChoice, choose_models

__all__ = [
    "COMPONENTS",
    "Variant",
    "benchmark_plan",
    "check_model",
    "data_plan",
    "jsonable",
    "model_choice",
    "model_node",
    "simulated_on",
    "sweep_name",
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
    """The variants of an algorithm: one, or one per value of the setting that is swept."""
    config = settings.algorithm_on(dataset, algorithm)
    if algorithm not in settings.variants:
        return [Variant(algorithm, config, algorithm)]
    name, chosen = settings.variants[algorithm]
    return [
        Variant(
            algorithm,
            replace(config, **{name: value}),
            f"{algorithm}-{name}-{value:g}",
            {name: f"{value:g}"},
        )
        for value in chosen
    ]


def _data_node(settings: Settings, name: str) -> Node:
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
        config={"model": name, "settings": jsonable(asdict(model)), "seed": seed},
        inputs={"dataset": data},
        tags={"dataset": dataset, "model": name} | ({} if shared else {"seed": str(seed)}),
        cost=MODELS[name].cost(model),
    )


def _policy_node(
    settings: Settings, variant: Variant, dataset: str, seed: int, inputs: Mapping[str, Node]
) -> Node:
    algorithm, config = ALGORITHMS[variant.algorithm], variant.config
    # A stack has one configuration, and data and models of one shape.
    models = {role: inputs[role].config["settings"] for role in algorithm.needs}
    source = settings.dataset[dataset]
    system = source.environment
    # A stored log may tell more about its system than the registry.
    stored = isinstance(source, StoredLog)
    dynamics = source.card.dynamics if stored else SYSTEMS[system].dynamics
    kind = digest([jsonable(asdict(config)), models, system], 4)
    return Node(
        component="policy_training",
        name=f"{variant.label}/{dataset}/seed{seed}",
        task="flows.tasks.policy_training:train",
        version=COMPONENTS["policy_training"],
        config={
            "algorithm": algorithm.name,
            "algorithm_version": algorithm.version_on(dynamics),
            "settings": jsonable(asdict(config)),
            "snapshots": settings.training.snapshots,
            "seed": seed,
        },
        inputs={role: inputs[role] for role in ("dataset", *algorithm.needs)},
        tags={"dataset": dataset, "algorithm": algorithm.name, "seed": str(seed), **variant.tags},
        lanes=f"train/{algorithm.name}/{kind}"
        + (f"/{dataset}" if settings.runner.stack == "pair" else ""),
        cost=algorithm.cost(config),
    )


def _evaluation_node(settings: Settings, variant: Variant, policy: Node, behaviour: Node) -> Node:
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
        lanes=f"evaluate/{variant.label}/{dataset}",
        cost=0.1 + 1e-3 * settings.training.snapshots * proximities * protocol.trajectories,
    )


def _aggregation_node(
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


def data_plan(settings: Settings) -> Plan:
    """Data generation alone.

    Raises:
        SettingsError: What a dataset is made with is missing or damaged.
    """
    return Plan([_data_node(settings, name) for name in settings.datasets])


def _needed_models(settings: Settings) -> list[str]:
    needed = {name for a in settings.algorithms for name in ALGORITHMS[a].needs}
    return sorted(needed | {"behaviour_policy"})  # distances are measured to it


def model_choice(settings: Settings) -> ModelChoice:
    """Settings of every model that the benchmark needs.

    Raises:
        SettingsError: Tuned ones are asked for and cannot be had.
    """
    data = {name: _data_node(settings, name) for name in settings.datasets}
    return choose_models(settings, _needed_models(settings), data)


def check_model(settings: Settings, dataset: str, model: Any) -> None:
    """Refuse a model that a dataset is too small, too short or too little described for.

    Args:
        settings: What is wanted.
        dataset: Name of the dataset.
        model: Configuration object of the model.

    Raises:
        SettingsError: Trajectories never fill an observation, there is none to hold out, they are
            too short for a recurrent ensemble, or the card of a stored log does not tell the
            dynamics specification that transition models need.
    """
    source = settings.dataset[dataset]
    stored = isinstance(source, StoredLog)
    _check_size(dataset, source)
    if stored and isinstance(model, RecurrentEnsembleConfig | MLPEnsembleConfig):
        try:
            DynamicsSpecification.of_card(source.card)
        except ValueError as error:
            raise SettingsError(
                f"{dataset}: {str(error).rstrip('.')}; or choose algorithms that need no "
                "transition model."
            ) from error
    if not isinstance(model, RecurrentEnsembleConfig):
        return
    if source.steps < model.warm_up + model.horizon:
        size = (
            f"{dataset} has {source.steps} steps an episode, which"
            if stored
            else (f"data.steps={settings.data.steps}")
        )
        raise SettingsError(
            f"{size} is less than warm_up + horizon = "
            f"{model.warm_up + model.horizon} of model.recurrent_ensemble; use longer episodes, or "
            "lower warm_up or horizon."
        )


def _check_size(dataset: str, source: DatasetSource) -> None:
    """Refuse a dataset without a single whole observation, or of a single episode."""
    if source.steps < source.history:
        raise SettingsError(
            f"{dataset} has {source.steps} steps an episode and never fills an observation of "
            f"{source.history} frames; use longer episodes (data.steps)."
        )
    if isinstance(source, RobotSpec) and source.transitions <= source.steps:
        raise SettingsError(
            f"{dataset}: data.transitions={source.transitions} may be a single episode of up to "
            f"{source.steps} steps, and models hold one out; raise data.transitions or lower "
            "data.steps."
        )
    if isinstance(source, StoredLog) and source.card.trajectories < 2:
        raise SettingsError(
            f"{dataset} has a single episode, and models hold one out; log at least two."
        )


def _check_algorithm(settings: Settings, dataset: str, name: str) -> None:
    """Refuse an algorithm that finds nothing to learn from in a dataset's short episodes."""
    config, source = settings.algorithm_on(dataset, name), settings.dataset[dataset]
    if source.steps <= getattr(config, "start_after", 0):
        raise SettingsError(
            f"algorithm.{name}.start_after={config.start_after}, but {dataset} has {source.steps} "
            "steps an episode; lower start_after."
        )
    # Episodes that end with a fall may be shorter: nothing is earned after it.
    if isinstance(source, IndustrialSpec) and source.steps < getattr(config, "window", 0):
        raise SettingsError(
            f"algorithm.{name}.window={config.window}, but {dataset} has {source.steps} steps an "
            "episode; lower window or use longer episodes (data.steps)."
        )


def benchmark_plan(settings: Settings, choice: ModelChoice | None = None) -> Plan:
    """The whole grid: datasets x algorithms x seeds, with all they need.

    Datasets without a system get neither evaluation nor aggregation.

    Args:
        settings: What is wanted.
        choice: Settings of the models, if they are known already.

    Raises:
        SettingsError: If a dataset does not suit the models, or what it is made with is missing or
            damaged.
    """
    choice = choice or model_choice(settings)
    for (dataset, _), config in choice.configs.items():
        check_model(settings, dataset, config)
    for dataset, name in product(settings.datasets, settings.algorithms):
        _check_algorithm(settings, dataset, name)
    nodes = []
    for dataset in settings.datasets:
        data = _data_node(settings, dataset)
        own = settings.models.per_seed
        seeds = settings.seeds if own else (0,)
        models = {
            seed: {
                name: model_node(name, config, dataset, data, seed, shared=not own)
                for (of, name), config in choice.configs.items()
                if of == dataset
            }
            for seed in seeds
        }
        reference = choice.configs[dataset, "behaviour_policy"]
        behaviour = model_node("behaviour_policy", reference, dataset, data)
        for algorithm in settings.algorithms:
            special = settings.models_for(dataset, algorithm)
            for variant in variants(settings, dataset, algorithm):
                policies = {}
                for seed in settings.seeds:
                    fitted = seed if own else 0
                    inputs = {"dataset": data, **models[fitted]}
                    for name, config in special.items():
                        inputs[name] = model_node(
                            name,
                            config,
                            dataset,
                            data,
                            fitted,
                            shared=not own,
                            for_algorithm=algorithm,
                        )
                    policies[seed] = _policy_node(settings, variant, dataset, seed, inputs)
                if settings.dataset[dataset].environment is None:
                    nodes += policies.values()  # there is no system to evaluate them on
                    continue
                evaluations = {
                    seed: _evaluation_node(settings, variant, policy, behaviour)
                    for seed, policy in policies.items()
                }
                nodes.append(_aggregation_node(settings, variant, dataset, evaluations))
    return Plan(nodes)


def sweep_name(settings: Settings, plan: Plan) -> str:
    """The sweep's own name, or the profile and a digest of the plan: equal for equal plans."""
    digest = hashlib.sha256("".join(sorted(node.key for node in plan)).encode()).hexdigest()
    return settings.sweep or f"{settings.profile_name}-{digest[:8]}"

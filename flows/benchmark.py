"""From settings to the plan of the benchmark: one node per component run."""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict
from typing import Any

from components.algorithms import ALGORITHMS
from components.environments import INDUSTRIAL_BENCHMARK_ID
from flows.pipeline.plan import Node, Plan
from flows.settings import Settings, SettingsError

__all__ = ["COMPONENTS", "benchmark_plan", "data_plan", "sweep_name"]

COMPONENTS = {
    "data_generation": 1,
    "model_fitting": 3,
    "policy_training": 2,
    "evaluation": 2,
    "aggregation": 2,
}
"""The components and the versions of their code; raise one when its results change."""


def _plain(value: Any) -> Any:
    """JSON-able copy: tuples become lists."""
    if isinstance(value, Mapping):
        return {str(k): _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, tuple | list) else value


def _data_node(settings: Settings, name: str) -> Node:
    spec = settings.dataset[name]
    return Node(
        component="data_generation",
        name=f"data/{name}",
        task="flows.tasks:generate_dataset",
        version=COMPONENTS["data_generation"],
        config={"spec": _plain(asdict(spec)), "seed": settings.data.seed},
        tags={"dataset": name},
        cost=1e-4 * spec.trajectories * spec.steps / 10,
    )


def _model_cost(name: str, model: Any) -> float:
    """Core-seconds on a machine of 2026."""
    if name == "recurrent_ensemble":
        steps = model.warm_up + model.horizon
        return 3.4e-7 * model.updates * model.batch * model.members * 2 * steps * model.hidden / 30
    return 0.5 * float(model.epochs)


def _model_node(settings: Settings, name: str, dataset: str, data: Node) -> Node:
    model = settings.model[name]
    return Node(
        component="model_fitting",
        name=f"{name}/{dataset}",
        task="flows.tasks:fit_model",
        version=COMPONENTS["model_fitting"],
        # The models of a dataset are shared by all seeds of all policies, so they have their own.
        config={"model": name, "settings": _plain(asdict(model)), "seed": 0},
        inputs={"dataset": data},
        tags={"dataset": dataset, "model": name},
        cost=_model_cost(name, model),
    )


_ROW_COST = {
    "bc": 6e-6,
    "ddpg": 2.2e-5,
    "bcq": 3.3e-4,
    "bear": 1.7e-4,
    "brac": 6.5e-5,
    "cql": 5.8e-4,
    "td3_bc": 2.5e-5,
    "lambda_td3_bc": 2.5e-5,
    "rvs": 6e-5,
}
"""Core-seconds per transition of a batch at the default sizes, on a machine of 2026."""


def _policy_cost(algorithm: str, config: Any) -> float:
    if algorithm == "lion":
        return 1.1e-5 * float(config.updates * config.trajectories * config.horizon)
    return _ROW_COST[algorithm] * float(config.updates * config.batch)


def _policy_node(
    settings: Settings, algorithm: str, dataset: str, seed: int, inputs: Mapping[str, Node]
) -> Node:
    module = ALGORITHMS[algorithm]
    config = settings.algorithm[algorithm]
    return Node(
        component="policy_training",
        name=f"{algorithm}/{dataset}/seed{seed}",
        task="flows.tasks:train",
        version=COMPONENTS["policy_training"],
        config={
            "algorithm": algorithm,
            "algorithm_version": module.VERSION,
            "settings": _plain(asdict(config)),
            "snapshots": settings.training.snapshots,
            "seed": seed,
        },
        inputs={role: inputs[role] for role in ("dataset", *module.NEEDS)},
        tags={"dataset": dataset, "algorithm": algorithm, "seed": str(seed)},
        lanes=f"train/{algorithm}" + (f"/{dataset}" if settings.runner.stack == "pair" else ""),
        cost=_policy_cost(algorithm, config),
    )


def _evaluation_node(settings: Settings, policy: Node, behaviour: Node) -> Node:
    dataset, algorithm = policy.tags["dataset"], policy.tags["algorithm"]
    spec = settings.dataset[dataset]
    protocol = settings.evaluation.model_dump() | {"discount": spec.discount}
    steered = ALGORITHMS[algorithm].TAKES_LAMBDA
    lambdas = round(1 / settings.evaluation.lambda_step) + 1 if steered else 1
    return Node(
        component="evaluation",
        name=f"evaluate/{policy.name}",
        task="flows.tasks:evaluate",
        version=COMPONENTS["evaluation"],
        config={
            "environment": INDUSTRIAL_BENCHMARK_ID,
            "parameters": {"setpoint": spec.setpoint},
            "evaluation": protocol,
            "stream": [dataset, algorithm, policy.config["seed"]],
        },
        inputs={"policy": policy, "behaviour_policy": behaviour},
        tags=policy.tags,
        lanes=f"evaluate/{algorithm}/{dataset}",
        cost=0.1 + 1e-3 * settings.training.snapshots * lambdas * settings.evaluation.trajectories,
    )


def _aggregation_node(settings: Settings, evaluations: Mapping[int, Node]) -> Node:
    tags = next(iter(evaluations.values())).tags
    dataset, algorithm = tags["dataset"], tags["algorithm"]
    return Node(
        component="aggregation",
        name=f"aggregate/{algorithm}/{dataset}",
        task="flows.tasks:aggregate",
        version=COMPONENTS["aggregation"],
        config={
            "dataset": dataset,
            "algorithm": algorithm,
            "seeds": sorted(evaluations),
            "pool_fraction": settings.aggregation.pool_fraction,
        },
        inputs={f"seed{seed}": node for seed, node in evaluations.items()},
        tags={"dataset": dataset, "algorithm": algorithm},
        cost=0.1,
    )


def data_plan(settings: Settings) -> Plan:
    """Data generation alone."""
    return Plan([_data_node(settings, name) for name in settings.datasets])


def benchmark_plan(settings: Settings) -> Plan:
    """The whole grid: datasets x algorithms x seeds, with all they need.

    Raises:
        SettingsError: If the trajectories are too short for the models.
    """
    model = settings.model["recurrent_ensemble"]
    needed = {name for a in settings.algorithms for name in ALGORITHMS[a].NEEDS}
    if "recurrent_ensemble" in needed and settings.data.steps < model.warm_up + model.horizon:
        raise SettingsError(
            f"data.steps={settings.data.steps} is less than warm_up + horizon = "
            f"{model.warm_up + model.horizon} of model.recurrent_ensemble; raise the one or "
            "lower the others."
        )
    nodes = []
    for dataset in settings.datasets:
        inputs = {"dataset": _data_node(settings, dataset)}
        for name in sorted(needed | {"behaviour_policy"}):  # which judges distances
            inputs[name] = _model_node(settings, name, dataset, inputs["dataset"])
        for algorithm in settings.algorithms:
            evaluations = {}
            for seed in settings.seeds:
                policy = _policy_node(settings, algorithm, dataset, seed, inputs)
                evaluations[seed] = _evaluation_node(settings, policy, inputs["behaviour_policy"])
            nodes.append(_aggregation_node(settings, evaluations))
    return Plan(nodes)


def sweep_name(settings: Settings, plan: Plan) -> str:
    """The sweep's own name, or the profile and a digest of the plan: equal for equal plans."""
    digest = hashlib.sha256("".join(sorted(node.key for node in plan)).encode()).hexdigest()
    return settings.sweep or f"{settings.profile_name}-{digest[:8]}"

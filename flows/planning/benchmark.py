"""From settings to the plan of the benchmark: datasets x algorithms x seeds."""

import hashlib
from itertools import product

from components.algorithms import ALGORITHMS
from flows.configuration.settings import Settings
from flows.pipeline.plan import Plan
from flows.planning.costs import data_sizes
from flows.planning.judging import (
    JUDGE_MODELS,
    is_judged,
    judge_models,
    judgement_node,
    part_node,
)
from flows.planning.model_choice import ModelChoice, choose_models
from flows.planning.nodes import (
    aggregation_node,
    data_node,
    evaluation_node,
    model_node,
    policy_node,
    variants,
)
from flows.planning.sizes import check_algorithm, check_model

__all__ = ["benchmark_plan", "data_plan", "model_choice", "sweep_name"]


def data_plan(settings: Settings) -> Plan:
    """Data generation alone.

    Raises:
        SettingsError: What a dataset is made with is missing or damaged.
    """
    return Plan([data_node(settings, name) for name in settings.datasets])


def _needed_models(settings: Settings, dataset: str) -> set[str]:
    """Those of the algorithms, and the one to which distances are measured."""
    needs = {
        name
        for a in settings.algorithms
        for variant in variants(settings, dataset, a)
        for name in ALGORITHMS[a].models_for(variant.config)
    }
    return needs | {"behaviour_policy"}


def model_choice(settings: Settings) -> ModelChoice:
    """Settings of every model that the benchmark needs.

    Raises:
        SettingsError: Tuned ones are asked for and cannot be had.
    """
    data = {name: data_node(settings, name) for name in settings.datasets}
    models = {name for of in settings.datasets for name in _needed_models(settings, of)}
    if any(is_judged(settings, dataset) for dataset in settings.datasets):
        models |= set(JUDGE_MODELS)
    return choose_models(settings, models, data)


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
    for (dataset, name), config in choice.configs.items():
        if name in _needed_models(settings, dataset):  # judges do without those that do not suit
            check_model(settings, dataset, config)
    for dataset, name in product(settings.datasets, settings.algorithms):
        check_algorithm(settings, dataset, name)
    nodes = []
    for dataset in settings.datasets:
        data = data_node(settings, dataset)
        judged = is_judged(settings, dataset)
        if judged:
            judges = judge_models(settings, data, choice.configs)
            data = part_node(settings, data, "train")
        sizes = data_sizes(settings.dataset[dataset])
        own = settings.models.per_seed
        seeds = settings.seeds if own else (0,)
        models = {
            seed: {
                name: model_node(name, config, dataset, data, sizes, seed, shared=not own)
                for (of, name), config in choice.configs.items()
                if of == dataset
            }
            for seed in seeds
        }
        reference = choice.configs[dataset, "behaviour_policy"]
        behaviour = model_node("behaviour_policy", reference, dataset, data, sizes)
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
                            sizes,
                            fitted,
                            shared=not own,
                            for_algorithm=algorithm,
                        )
                    policies[seed] = policy_node(settings, variant, dataset, seed, inputs)
                if judged:
                    nodes += [
                        judgement_node(settings, policy, variant.config, judges)
                        for policy in policies.values()
                    ]
                if settings.dataset[dataset].environment is None:
                    nodes += policies.values()  # there is no system to evaluate them on
                    continue
                evaluations = {
                    seed: evaluation_node(settings, variant, policy, behaviour)
                    for seed, policy in policies.items()
                }
                nodes.append(aggregation_node(settings, variant, dataset, evaluations))
    return Plan(nodes)


def sweep_name(settings: Settings, plan: Plan) -> str:
    """The sweep's own name, or the profile and a digest of the plan: equal for equal plans."""
    digest = hashlib.sha256("".join(sorted(node.key for node in plan)).encode()).hexdigest()
    return settings.sweep or f"{settings.profile_name}-{digest[:8]}"

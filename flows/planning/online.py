"""The plan of thesis figure 2.3: one learner online, and the same one offline on what it logged."""

from collections.abc import Iterator
from dataclasses import replace

from components.algorithms import ddpg
from components.data.sources.robots import RobotSpec
from components.evaluation.protocol import EvaluationProtocol
from flows.configuration.checking import SettingsError
from flows.configuration.settings import Settings
from flows.pipeline.plan import Node, Plan
from flows.planning.costs import data_sizes
from flows.planning.experts import expert_plan
from flows.planning.nodes import Variant, evaluation_node, jsonable, model_node, policy_node

__all__ = ["LOGS", "online_plan"]

LOGS = ("replay", "final")
"""What the offline learner is given: all that was collected online, or episodes of its policy."""


def online_plan(settings: Settings) -> Plan:
    """For every robot and seed: online training, its two logs, and offline training on each.

    The offline learner has the online one's networks, rates and number of updates, and its policies
    are evaluated as the online one's are: undiscounted returns of whole episodes.

    Raises:
        SettingsError: A dataset is none of a robot.
    """
    return Plan(node for dataset in settings.datasets for node in _of_dataset(settings, dataset))


def _of_dataset(settings: Settings, dataset: str) -> Iterator[Node]:
    source = settings.dataset[dataset]
    if not isinstance(source, RobotSpec):
        raise SettingsError(f"{dataset} is no robot, where alone controllers are trained online.")
    experts = settings.experts.model_copy(
        update={"robots": (source.robot,), "seeds": settings.seeds, "physics": source.physics}
    )
    trained = expert_plan(settings.model_copy(update={"experts": experts})).by_component()
    training = settings.experts.training
    if not isinstance(training.learner, ddpg.Config):
        raise SettingsError(
            "DDPG online is compared with DDPG offline, but experts.training.method="
            f"{training.method}; leave it at ddpg."
        )
    whole = EvaluationProtocol(trajectories=training.episodes, horizon=training.horizon)
    counted = settings.model_copy(
        update={"evaluation": whole, "dataset": {dataset: replace(source, discount=1.0)}}
    )
    updates = max(training.steps - training.random_steps, settings.training.snapshots)
    learner = replace(training.learner, updates=updates)
    sizes = data_sizes(source)
    for node in trained["expert_training"]:
        online = replace(node, config={**node.config, "keeps_transitions": True})
        seed = online.config["seed"]
        for log in LOGS:
            data = _log_node(online, source, log)
            model = settings.model_on(dataset, "behaviour_policy")
            behaviour = model_node(
                "behaviour_policy", model, dataset, data, sizes, seed, shared=False
            )
            variant = Variant("ddpg", learner, f"ddpg-{log}", {"log": log})
            policy = policy_node(settings, variant, dataset, seed, {"dataset": data})
            yield evaluation_node(counted, variant, policy, behaviour)


def _log_node(online: Node, source: RobotSpec, log: str) -> Node:
    training = online.config["training"]
    spec = replace(
        source, epsilon=0.0, noise=0.0, transitions=training["steps"], steps=training["horizon"]
    )
    shared = {key: online.config[key] for key in ("training", "simulator", "seed")}
    return Node(
        component="online_log",
        name=f"log/{log}/{source.name}/seed{online.config['seed']}",
        task="flows.tasks.experts:log_episodes",
        version=1,
        config={"spec": jsonable(spec.identity), "log": log, **shared},
        inputs={"online": online},
        tags={"dataset": source.name, "seed": online.tags["seed"], "log": log},
        cost=1e-4 * training["steps"],
    )

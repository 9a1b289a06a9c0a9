"""Experts as task functions: training, one lane per seed, the choice of a seed, and logs.

This is data generation: all of it runs the real system, and nothing but the data logged by the
chosen expert reaches a learner.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from functools import partial
from typing import Any, Final

import numpy as np
import torch

from components.core.integrity import load_json
from components.core.random_streams import lane_generator, lane_key
from components.data.assembly import assemble
from components.data.controllers.trained.shipped import Expert, ExpertCard, act_in_double
from components.data.returns import RETURN_STEPS
from components.data.sources.robot_collection import (
    Exploration,
    collect_episodes,
    episode_arrays,
)
from components.data.sources.robots import RobotSpec
from components.environments.mujoco.robots import Robots
from components.environments.mujoco.specifications import ROBOTS, simulator_version
from components.environments.systems import check_simulator
from components.experts.config import ExpertConfig
from components.experts.episodes import evaluate_episodes
from components.experts.replay import replayed_episodes
from components.experts.training import train_experts
from components.policies.policy import Policy
from components.training.divergence import DivergedError, diverged
from components.training.memory import keep_freed_memory
from flows.pipeline.task import Job, TaskContext
from flows.tasks.artifacts import (
    config_object,
    note_dataset,
    noting_lost_graphs,
    read_input,
    write_curves,
    write_numbers,
)

__all__ = ["TRANSITIONS", "choose_expert", "log_episodes", "train_expert"]

TRANSITIONS: Final = "transitions.npy"
"""The replay memory of a training, where it is kept."""

_REACHED = "reached.json"
_COPIES: Final = 100  # stepped together; the log does not depend on their number


def _robots(config: Mapping[str, Any], copies: int, threads: int) -> Robots:
    check_simulator(ROBOTS[config["robot"]].id, config["simulator"])
    return Robots(ROBOTS[config["robot"]], copies, config["physics"], threads)


def train_expert(jobs: Sequence[Job], context: TaskContext) -> None:
    """Expert training: `policy/` holds the best policy of a seed; one lane per job.

    Where the configuration says so, `transitions.npy` holds the replay memory.
    """
    keep_freed_memory()
    first = jobs[0].config
    with noting_lost_graphs(jobs):
        policies, returns, curves = train_experts(
            first["robot"],
            config_object(ExpertConfig, first["training"]),
            [lane_key("expert", first["robot"], job.config["seed"]) for job in jobs],
            [job.key for job in jobs],
            lambda copies: _robots(first, copies, context.threads),
            work=context.work,
            device=torch.device(context.device),
            progress=context.progress,
        )
    for lane, (job, policy) in enumerate(zip(jobs, policies, strict=True)):
        if isinstance(policy, DivergedError):
            settings = job.config["training"]
            job.fail(diverged(f"The training of {job.name}", policy, "experts.training", settings))
            continue
        (job.out / "policy").mkdir()
        policy.save(job.out / "policy")
        if job.config.get("keeps_transitions"):
            _keep_transitions(job, context, policy)
        reached = {"return": returns[lane], "step": policy.card.steps[0]}
        write_numbers(job.out / _REACHED, reached)
        metrics = {f"best/{name}": value for name, value in reached.items()}
        if policy.card.ended_at is not None:
            metrics["training/ended_at"] = policy.card.ended_at
        write_numbers(job.out / "metrics.json", metrics)
        write_curves(job.out / "curves.npz", curves.of_lane(lane))


def _keep_transitions(job: Job, context: TaskContext, policy: Policy) -> None:
    width = 2 * len(policy.card.features) + policy.card.actions + 2
    rows = np.fromfile(context.work / f"{job.key}.transitions", np.float32)
    np.save(job.out / TRANSITIONS, rows.reshape(-1, width))


def log_episodes(jobs: Sequence[Job], context: TaskContext) -> None:
    """Logs of an online training: `dataset/` holds what it collected, or episodes of its policy."""
    for job in jobs:
        config, replayed = job.config, job.config["log"] == "replay"
        spec, exploration = RobotSpec(**config["spec"]), config["training"]["exploration"]
        policy = read_input(job, "online", Policy.load, "policy")
        if replayed:
            rows = read_input(job, "online", np.load, TRANSITIONS)
            widths = len(policy.card.features), policy.card.actions
            episodes = replayed_episodes(rows, *widths, spec.steps)
        else:
            robot = {"robot": spec.robot, "physics": spec.physics, "simulator": config["simulator"]}
            episodes = collect_episodes(
                partial(act_in_double, policy),
                _robots(robot, min(_COPIES, spec.transitions), context.threads),
                Exploration(0.0, 0.0),
                horizon=spec.steps,
                transitions=spec.transitions,
                key=lane_key("online log", spec.name, config["seed"]),
            )
        dataset = assemble(
            episode_arrays(episodes),
            discount=spec.discount,
            name=spec.name,
            environment=spec.environment,
            environment_parameters=spec.environment_parameters,
            controller="online DDPG",
            epsilon=0.0,
            noise=exploration if replayed else 0.0,
            seed=config["seed"],
            history=spec.history,
            frame_features=policy.card.features,
            action_features=ROBOTS[spec.robot].action_features,
            dynamics=ROBOTS[spec.robot].dynamics,
            simulator=simulator_version(),
        )
        dataset.write(job.out / "dataset")
        note_dataset(job, dataset)


def choose_expert(jobs: Sequence[Job], context: TaskContext) -> None:
    """Expert choice: `expert/` holds the best seed's policy and its returns in new episodes."""
    for job in jobs:
        config = job.config
        reached = {
            seed: read_input(job, f"seed{seed}", load_json, _REACHED) for seed in config["seeds"]
        }
        # An undefined return would neither be less nor greater than any other.
        finite = [seed for seed in reached if math.isfinite(reached[seed]["return"])]
        if not finite:
            raise ValueError(
                f"No seed of {config['robot']} has reached a finite return: there is no expert to "
                "choose; change experts.training or the seeds."
            )
        best = max(finite, key=lambda seed: reached[seed]["return"])
        policy = read_input(job, f"seed{best}", Policy.load, "policy")
        training = config["training"]
        return_steps = min(RETURN_STEPS, training["horizon"])
        key = lane_key("expert", config["robot"], "verdict")
        returns = evaluate_episodes(
            lambda frames, policy=policy: act_in_double(policy, frames),
            _robots(config, config["episodes"], context.threads),
            [lane_generator(key, episode) for episode in range(config["episodes"])],
            horizon=training["horizon"],
            discount=config["discount"],
            return_steps=return_steps,
        )
        card = ExpertCard(
            robot=config["robot"],
            environment=ROBOTS[config["robot"]].id,
            physics=config["physics"],
            simulator=simulator_version(),
            seed=best,
            candidates={str(seed): reached[seed]["return"] for seed in finite},
            step=reached[best]["step"],
            training=training,
            episodes=config["episodes"],
            return_steps=return_steps,
            discount=config["discount"],
            **asdict(returns),
        )
        (job.out / "expert").mkdir()
        Expert(policy, card).save(job.out / "expert")
        write_numbers(job.out / "metrics.json", {**asdict(returns), "seed": best})

"""From settings to the plan of expert training: one node per robot and seed, and a choice."""

from components.core.options import identity
from components.environments.mujoco.specifications import ROBOTS
from flows.configuration.settings import Settings
from flows.pipeline.plan import Node, Plan
from flows.planning.nodes import jsonable, simulated_on

__all__ = ["expert_plan"]

COMPONENTS = {"expert_training": 2, "expert_choice": 2}
"""The components and the versions of their code; raise one when its results change."""

_STEP_COST = 3.5e-3  # core-seconds per environment step and update of one seed


def expert_plan(settings: Settings) -> Plan:
    """Training of every robot and seed, and the choice of a seed per robot."""
    experts = settings.experts
    nodes = []
    for robot in experts.robots:
        shared = {
            "robot": robot,
            "physics": experts.physics,
            "training": jsonable(identity(experts.training)),
            **simulated_on(ROBOTS[robot].id),
        }
        trained = {
            f"seed{seed}": Node(
                component="expert_training",
                name=f"expert/{robot}/seed{seed}",
                task="flows.tasks.experts:train_expert",
                version=COMPONENTS["expert_training"],
                config={**shared, "seed": seed},
                tags={"robot": robot, "seed": str(seed)},
                lanes=f"expert/{robot}",
                cost=_STEP_COST * experts.training.steps,
            )
            for seed in experts.seeds
        }
        nodes.append(
            Node(
                component="expert_choice",
                name=f"expert/{robot}",
                task="flows.tasks.experts:choose_expert",
                version=COMPONENTS["expert_choice"],
                config={
                    **shared,
                    "seeds": sorted(experts.seeds),
                    "episodes": experts.episodes,
                    "discount": experts.discount,
                },
                inputs=trained,
                tags={"robot": robot},
                cost=1e-4 * experts.episodes * experts.training.horizon,
            )
        )
    return Plan(nodes)

"""From settings to the plan of expert training: one node per robot and seed, a choice, a search."""

from dataclasses import asdict

from components.environments.mujoco.specifications import ROBOTS
from flows.configuration.settings import Settings
from flows.pipeline.plan import Node, Plan
from flows.planning.nodes import jsonable, simulated_on

__all__ = ["expert_plan", "final_experts"]

COMPONENTS = {"expert_training": 2, "expert_choice": 2, "expert_refinement": 1}
"""The components and the versions of their code; raise one when its results change."""

_STEP_COST = 3.5e-3  # core-seconds per environment step and update of one seed
_EPISODE_COST = 1e-4  # per step of an episode without learning


def expert_plan(settings: Settings) -> Plan:
    """Training of every robot and seed, and the choice of a seed per robot."""
    experts = settings.experts
    nodes = []
    for robot in experts.robots:
        system = {"robot": robot, "physics": experts.physics, **simulated_on(ROBOTS[robot].id)}
        verdict = {"episodes": experts.episodes, "discount": experts.discount}
        shared = {**system, "training": jsonable(asdict(experts.training))}
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
        chosen = Node(
            component="expert_choice",
            name=f"expert/{robot}",
            task="flows.tasks.experts:choose_expert",
            version=COMPONENTS["expert_choice"],
            config={
                **shared,
                "seeds": sorted(experts.seeds),
                **verdict,
            },
            inputs=trained,
            tags={"robot": robot},
            cost=_EPISODE_COST * experts.episodes * experts.training.horizon,
        )
        nodes.append(chosen)
        search = experts.refinement
        if search.iterations:
            episodes = 2 * search.directions * search.iterations
            nodes.append(
                Node(
                    component="expert_refinement",
                    name=f"refined expert/{robot}",
                    task="flows.tasks.experts:refine_expert",
                    version=COMPONENTS["expert_refinement"],
                    config={**system, **verdict, "refinement": jsonable(asdict(search))},
                    inputs={"expert": chosen},
                    tags={"robot": robot},
                    cost=_EPISODE_COST * episodes * experts.training.horizon,
                )
            )
    return Plan(nodes)


def final_experts(plan: Plan) -> list[Node]:
    """The node of every robot that holds its expert: the last one."""
    last = {n.tags["robot"]: n for n in plan if n.component != "expert_training"}
    return list(last.values())

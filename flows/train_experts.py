"""Experts of the robots: ``python -m flows.train_experts robots=[swimmer] seeds=[0,1,2,3]``.

This is online training on the real system, for data generation; no offline learner takes part. All
seeds of a robot train side by side as lanes of one program; the best of them, by its evaluations
during training, becomes the expert.
"""

from pathlib import Path

from components.data.controllers.trained.shipped import SHIPPED, Expert
from components.environments.mujoco.specifications import PHYSICS, ROBOTS
from flows.command_line import COMMON_HELP, Metrics, main, run_sweep
from flows.configuration.settings import RUNNER_ALIASES, Settings
from flows.pipeline.runner import Outcome
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import sweep_name
from flows.planning.experts import expert_plan

HELP = f"""\
usage: python -m flows.train_experts [KEY=VALUE ...]

Train the controllers that log the robot datasets: DDPG or TD3 on the robots themselves, all seeds
of a robot together, for hours. To continue a training that was stopped, give the same command
again.

  profile=smoke                   a training of seconds, for tests; paper is the default
  robots=[a,b]                    {", ".join(ROBOTS)}, or all
  seeds=[0,1,2,3]                 whole numbers; the best seed becomes the expert
  steps=1000000                   environment steps per seed
  physics={"|".join(PHYSICS)}                   of the robots; v3, as in the thesis, is the default
  install=true                    put the experts where dataset generation looks for them
  experts.episodes=100            episodes that evaluate the chosen expert
  experts.discount=0.99           of the returns on its card
  experts.training.method=td3     in place of ddpg, for a robot that DDPG does not master
  experts.training.KEY=VALUE      a setting of the training, e.g. experts.training.exploration=0.2
{COMMON_HELP}"""

ALIASES = RUNNER_ALIASES | {
    "robots": "experts.robots",
    "seeds": "experts.seeds",
    "physics": "experts.physics",
    "install": "experts.install",
    "steps": "experts.training.steps",
}


def _run(settings: Settings) -> int:
    plan = expert_plan(settings)
    store = ArtifactStore(settings.store, create=not settings.dry_run)

    def report(outcome: Outcome) -> tuple[list[Path], Metrics]:
        metrics: dict[str, list[tuple[int, float]]] = {}
        chosen = [node for node in plan if node.component == "expert_choice"]
        print(
            f"{'expert':<10}{'seed':>5}{'step':>9}{'return':>10}{'std':>8}{'100 steps':>11}  folder"
        )
        for node in chosen:
            if not store.complete(node.key):
                continue
            folder = store.path(node.key) / "expert"
            expert = Expert.load(folder)
            card = expert.card
            place = settings.store / folder.relative_to(store.root)
            if settings.experts.install:
                place = SHIPPED / card.robot
                place.mkdir(exist_ok=True)
                expert.save(place)
            print(
                f"{card.robot:<10}{card.seed:>5}{card.step:>9}{card.return_mean:>10.1f}"
                f"{card.return_std:>8.1f}{card.discounted_return_mean:>11.1f}  {place}/"
            )
            metrics[f"return/{card.robot}"] = [(0, card.return_mean)]
        return [], metrics

    experts = settings.experts
    params = {"robots": ",".join(experts.robots), "seeds": ",".join(map(str, experts.seeds))}
    return run_sweep(settings, f"experts-{sweep_name(settings, plan)}", plan, report, params)


if __name__ == "__main__":
    main("train_experts", HELP, _run, ALIASES)

"""The benchmark that is soaked: ``python -m tests.soak.driver KEY=VALUE ...``.

Everything is as in flows.full_benchmark, but that trainings write a checkpoint every fifth of a
second, so that kills meet some.
"""

import flows

flows.leave_quietly()  # as for every command of the project

from dataclasses import replace

from flows.command_line import main, run_sweep
from flows.configuration.settings import Settings
from flows.pipeline.plan import Node, Plan
from flows.pipeline.runner import Outcome
from flows.pipeline.store import ArtifactStore
from flows.planning.benchmark import benchmark_plan

__all__ = ["soaked_plan"]

_TASKS = {
    "flows.tasks.policy_training:train": "tests.soak.tasks:train",
    "flows.tasks.model_fitting:fit_model": "tests.soak.tasks:fit_model",
}


def soaked_plan(settings: Settings) -> Plan:
    """The plan of the benchmark; its keys are the same, since no module's name is part of one."""
    made: dict[str, Node] = {}
    for node in benchmark_plan(settings):
        inputs = {role: made[source.key] for role, source in node.inputs.items()}
        made[node.key] = replace(node, inputs=inputs, task=_TASKS.get(node.task, node.task))
    return Plan(made.values())


def _run(settings: Settings) -> int:
    from flows.report.report import write_report

    plan = soaked_plan(settings)
    folder = settings.store / "reports" / "soak"

    def report(outcome: Outcome) -> tuple[list, dict]:
        written = write_report(folder, plan, ArtifactStore(settings.store), "soak")
        return written.files, written.headline

    return run_sweep(settings, "soak", plan, report)


if __name__ == "__main__":
    main("soak", __doc__ or "", _run)

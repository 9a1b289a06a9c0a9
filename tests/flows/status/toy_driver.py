"""A driver of a toy sweep, to be looked at, stopped and killed.

python -m tests.flows.status.toy_driver STORE LOG serial|ray
"""

import sys
from pathlib import Path

from flows.pipeline.driver import driving
from flows.pipeline.executors.executor import Executor
from flows.pipeline.executors.ray import RayExecutor
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.plan import Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.signals import ending_signals
from flows.pipeline.store import ArtifactStore
from flows.pipeline.sweep_records import SweepRecord
from flows.pipeline.tracking.tracker import NullTracker
from tests.flows.pipeline.toys import count, diamond

HOLD = 12  # the step at which the counters wait to be told to go on
NAME, COMMAND = "toys", "make it so"


def toy_plan(log: Path) -> Plan:
    """Two numbers, two groups of three counters, a sum."""
    return Plan(diamond(log, pause=0.1, hold=HOLD))


def main(home: Path, log: Path, kind: str) -> int:
    """Runs the toy sweep on two processors, or in this process."""
    plan, store = toy_plan(log), ArtifactStore(home)
    executor: Executor = RayExecutor(cpus=2) if kind == "ray" else SerialExecutor()
    SweepRecord.of(NAME, COMMAND, plan).save(store.root)
    with ending_signals(), driving(store, NAME, COMMAND) as driver:
        count(str(log), "drivers")
        outcome = run_plan(
            plan, store, NullTracker(), Display(), executor=executor, command=COMMAND, driver=driver
        )
        driver.status = outcome.status
    return outcome.exit_code


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3]))

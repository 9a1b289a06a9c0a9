"""A driver of toys with MLflow, which may share a store with another, and whose clock may jump.

python -m tests.flows.pipeline.fault_driver STORE LOG NAME SECONDS

The clock is SECONDS off as soon as the file `go` is in the folder LOG.
"""

import sys
import time
from pathlib import Path

from flows.pipeline.driver import driving
from flows.pipeline.errors import PipelineError
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.leftovers import store_in_use
from flows.pipeline.plan import Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from tests.flows.pipeline.toys import count, diamond

HOLD = 12  # the step at which the counters wait to be told to go on

_clock = time.time


def shared_plan(log: Path) -> Plan:
    """Two numbers, two groups of three counters that wait as long as a test lasts, a sum."""
    return Plan(diamond(log, pause=0.0, hold=HOLD, patience=600.0))


def main(home: Path, log: Path, name: str, seconds: float) -> int:
    """Runs the diamond in this process."""
    time.time = lambda: _clock() + (seconds if (log / "go").exists() else 0.0)
    plan, store = shared_plan(log), ArtifactStore(home)
    tracker = MlflowTracker(home)
    status = "FAILED"
    try:
        with store_in_use(store):
            tracker.open(name, plan=plan)
            count(str(log), "drivers")
            with driving(store, name, "make it so") as driver:
                executor = SerialExecutor()
                outcome = run_plan(
                    plan, store, tracker, Display(), executor=executor, driver=driver
                )
                driver.status = status = outcome.status
    except PipelineError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    finally:
        tracker.close(status)
    return outcome.exit_code


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2]), sys.argv[3], float(sys.argv[4])))

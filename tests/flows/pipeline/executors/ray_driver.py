"""A driver with Ray and MLflow, to be killed.

python -m tests.flows.pipeline.executors.ray_driver STORE LOG
"""

import sys
from pathlib import Path

from flows.pipeline.errors import PipelineError
from flows.pipeline.executors.ray import RayExecutor
from flows.pipeline.plan import Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.signals import ending_signals
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from tests.flows.pipeline.toys import count, diamond

HOLD = 12  # the step at which the counters wait to be told to go on


def main(home: Path, log: Path) -> int:
    """Runs the diamond on two processors."""
    plan = Plan(diamond(log, pause=0.2, hold=HOLD))
    store, tracker = ArtifactStore(home), MlflowTracker(home)
    tracker.open("killed", plan=plan)
    count(str(log), "drivers")
    try:
        with ending_signals():
            outcome = run_plan(plan, store, tracker, Display(), executor=RayExecutor(cpus=2))
    except PipelineError as error:
        tracker.close("FAILED")
        sys.stderr.write(f"{error}\n")
        return 1
    tracker.close(outcome.status)
    return outcome.exit_code


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2])))

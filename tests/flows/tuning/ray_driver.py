"""A search of the toy with Ray and MLflow, to be killed.

python -m tests.flows.tuning.ray_driver STORE LOG TRIALS
"""

import sys
from pathlib import Path

from flows.pipeline.executors.ray import RayExecutor
from flows.tuning.mlflow_trials import MlflowTrials
from tests.flows.tuning.toys import run


def main(home: Path, log: Path, trials: int) -> int:
    """Searches on two processors."""
    tracker = MlflowTrials(home)
    tracker.open("search")
    outcome = run(home, log, trials, tracker=tracker, executor=RayExecutor(cpus=2))
    tracker.close(outcome.status)
    return outcome.exit_code


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3])))

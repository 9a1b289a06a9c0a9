"""A driver of a cluster whose machines share nothing but the URL of a store.

python -m tests.flows.pipeline.remote.apart_driver URL LOG
"""

import sys
from pathlib import Path

from flows.pipeline.errors import PipelineError
from flows.pipeline.executors.code import PACKAGES
from flows.pipeline.executors.ray import RayExecutor
from flows.pipeline.plan import Plan
from flows.pipeline.progress import Display
from flows.pipeline.remote.places import copy_of
from flows.pipeline.remote.shared_store import store_at
from flows.pipeline.runner import run_plan
from flows.pipeline.tracking.tracker import NullTracker
from tests.flows.pipeline.toys import diamond

HOLD = 12  # the step at which the counters wait to be told to go on


def main(url: str, log: Path) -> int:
    """Runs the diamond on every machine of the cluster."""
    packages = (*PACKAGES, "tests")  # the toys travel, too
    plan = Plan(diamond(log, hold=HOLD))
    store = store_at(copy_of(url), drives=True)
    executor = RayExecutor(root=store.root, url=url, retries=0, packages=packages)
    try:
        with store.driven("apart"):
            outcome = run_plan(plan, store, NullTracker(), Display(), executor=executor)
    except PipelineError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return outcome.exit_code


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], Path(sys.argv[2])))

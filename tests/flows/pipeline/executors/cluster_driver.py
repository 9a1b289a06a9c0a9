"""Two Ray machines on this computer, one of them with other code, one of which dies.

python -m tests.flows.pipeline.executors.cluster_driver STORE LOG FOREIGN
"""

import os
import signal
import sys
import threading
from pathlib import Path

from ray.cluster_utils import Cluster

from flows.pipeline.errors import PipelineError
from flows.pipeline.executors.ray import RayExecutor
from flows.pipeline.plan import Plan
from flows.pipeline.progress import Display
from flows.pipeline.runner import run_plan
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.tracker import NullTracker
from tests.flows.pipeline.toys import counted, diamond, wait_for

HOLD = 12  # the step at which the counters wait to be told to go on
MACHINE = {"num_cpus": 1, "object_store_memory": 100 * 2**20}


def refused(executor: RayExecutor) -> str:
    """Why the executor does not start."""
    try:
        executor.start(lambda text: None)
    except PipelineError as error:
        return str(error)
    finally:
        executor.stop()
    return "it starts"


def main(home: Path, log: Path, foreign: Path) -> int:
    """Prints what two executors say, and then how a plan ends while a machine dies."""
    store = ArtifactStore(home)
    head = MACHINE | {"include_dashboard": False}
    cluster = Cluster(initialize_head=True, head_node_args=head)
    os.environ["RAY_ADDRESS"] = cluster.address
    other = cluster.add_node(**MACHINE, env_vars={"PYTHONPATH": str(foreign)})
    say = sys.stdout.write
    say(refused(RayExecutor(root=home)) + "\n")
    cluster.remove_node(other)
    say(refused(RayExecutor(root=home, threads=2)) + "\n")
    second = cluster.add_node(**MACHINE)

    def kill() -> None:
        wait_for(lambda: counted(log, "holding") >= 2, "both groups to wait")
        raylet = second.all_processes["raylet"][0].process.pid
        children = Path(f"/proc/{raylet}/task/{raylet}/children").read_text(encoding="utf-8")
        for process in (raylet, *map(int, children.split())):  # as a machine dies, at once
            os.kill(process, signal.SIGKILL)

    class Screen(Display):
        def note(self, text: str) -> None:
            say(f"{text}\n")
            (log / "go").touch()

    threading.Thread(target=kill, daemon=True).start()
    plan = Plan(diamond(log, hold=HOLD))
    executor = RayExecutor(root=home, retries=0)
    outcome = run_plan(plan, store, NullTracker(), Screen(), executor=executor)
    say(f"{len(outcome.finished)} {outcome.failed}\n")
    cluster.shutdown()
    return outcome.exit_code


if __name__ == "__main__":
    sys.exit(main(*map(Path, sys.argv[1:])))

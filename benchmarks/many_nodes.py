"""What a node costs in plans of a thousand and of ten thousand that do nothing.

`python -m benchmarks.many_nodes --nodes 1000 10000 [--executor serial] [--tracker mlflow]`. Half of
the nodes read the other half. Each plan runs in a process of its own, whose greatest memory is that
of the driver: with Ray the workers are others. Of the processor's time only the driver's counts,
which other programs on the computer change less than the clock's. With MLflow the store is then
shown: the requests that its page of runs sends to a real server, one for the hundred newest runs
and one for the sweeps, and the seconds until they are answered, the median of five.
"""

import argparse
import json
import resource
import statistics
import subprocess
import sys
import tempfile
import time
import urllib.request
from dataclasses import asdict, dataclass
from pathlib import Path

from benchmarks.measure import computer, markdown
from benchmarks.pipeline import empty_plan, own_database, run_empty
from flows.pipeline.executors.executor import Executor
from flows.pipeline.executors.ray import RayExecutor
from flows.pipeline.executors.serial import SerialExecutor
from flows.pipeline.store import ArtifactStore
from flows.pipeline.tracking.mlflow_address import StoreAddress
from flows.pipeline.tracking.mlflow_tracker import MlflowTracker
from flows.pipeline.tracking.mlflow_ui import UiServer
from flows.pipeline.tracking.tracker import NullTracker

__all__ = ["Cost", "cost_of_nodes", "report"]

_LISTED = {"the newest runs": "", "the sweeps": "tags.role = 'sweep'"}


@dataclass(frozen=True)
class Cost:
    """What a plan of empty nodes has cost.

    Attributes:
        nodes: How many.
        wall: Seconds.
        processor: Of these the driver's own seconds on a processor.
        found: Seconds on a processor of the same plan again, everything finished.
        memory: The driver's greatest, in MiB.
        listed: Seconds until a real server has answered what its pages ask; empty without MLflow.
    """

    nodes: int
    wall: float
    processor: float
    found: float
    memory: float
    listed: dict[str, float]


def cost_of_nodes(nodes: int, executor: str, tracker: str, folder: Path) -> Cost:
    """Runs a plan of empty nodes in this process, twice.

    Args:
        nodes: An even number.
        executor: "serial" or "ray", on two processors.
        tracker: "mlflow" or "none".
        folder: For the store.

    Raises:
        RuntimeError: A node failed.
    """
    store = ArtifactStore(folder / "mlruns")

    def computes() -> Executor:
        return SerialExecutor() if executor == "serial" else RayExecutor(cpus=2)

    with own_database():
        recorded = NullTracker() if tracker == "none" else MlflowTracker(store.root, source="bench")
        plan = empty_plan(nodes, 0)
        recorded.open("empty", plan=plan)
        begun, used = time.perf_counter(), time.process_time()
        run_empty(plan, store, recorded, computes())
        wall, processor = time.perf_counter() - begun, time.process_time() - used
        recorded.close("FINISHED")
        used = time.process_time()
        if tracker == "mlflow":
            recorded = MlflowTracker(store.root, source="bench")
        recorded.open("empty", plan=plan)
        run_empty(plan, store, recorded, computes())
        recorded.close("FINISHED")
        found = time.process_time() - used
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        listed = {} if tracker == "none" else _listing(store.root)
    return Cost(nodes, wall, processor, found, memory, listed)


def _listing(root: Path) -> dict[str, float]:
    tracker = MlflowTracker(root, source="bench")
    port = 5000 + hash(str(root)) % 5000
    found = {}
    with UiServer(StoreAddress(root), port, tracker.experiment.entity()):
        for name, text in _LISTED.items():
            body = {"experiment_ids": [tracker.experiment.id], "filter": text, "max_results": 100}
            body |= {"order_by": ["attributes.start_time DESC"], "run_view_type": "ACTIVE_ONLY"}
            timings = []
            for _ in range(5):
                request = urllib.request.Request(
                    f"http://127.0.0.1:{port}/ajax-api/2.0/mlflow/runs/search",
                    json.dumps(body).encode(),
                    {"Content-Type": "application/json"},
                )
                begun = time.perf_counter()
                with urllib.request.urlopen(request, timeout=60) as answer:
                    runs = json.loads(answer.read())["runs"]
                timings.append(time.perf_counter() - begun)
            if not runs:
                raise RuntimeError(f"MLflow lists no runs for {name}.")
            found[name] = statistics.median(timings)
    return found


def report(nodes: list[int], executor: str, tracker: str) -> str:
    """A Markdown table, one row per plan, each measured in a process of its own."""
    rows = []
    for number in nodes:
        words = ["--nodes", str(number), "--executor", executor, "--tracker", tracker, "--json"]
        done = subprocess.run(
            [sys.executable, "-m", "benchmarks.many_nodes", *words],
            stdout=subprocess.PIPE,
            check=True,
            text=True,
        )
        cost = Cost(**json.loads(done.stdout.splitlines()[-1]))
        listed = " and ".join(f"{seconds:.2f}" for seconds in cost.listed.values()) or "-"
        each = [1e3 * part / number for part in (cost.wall, cost.processor, cost.found)]
        rows.append([f"{number:,}", *(f"{ms:,.1f}" for ms in each), f"{cost.memory:.0f}", listed])
    columns = [
        "nodes",
        "ms per node",
        "of the driver's processor",
        "to find it again",
        "MiB",
        "pages, s",
    ]
    return markdown(columns, rows)


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.many_nodes", description=__doc__)
    parser.add_argument("--nodes", type=int, nargs="+", default=[1000, 10000])
    parser.add_argument("--executor", choices=["serial", "ray"], default="serial")
    parser.add_argument("--tracker", choices=["mlflow", "none"], default="mlflow")
    parser.add_argument("--json", action="store_true", help="one plan, here, for programs")
    options = parser.parse_args()
    if options.json:
        with tempfile.TemporaryDirectory() as folder:
            [number] = options.nodes
            cost = cost_of_nodes(number, options.executor, options.tracker, Path(folder))
            print(json.dumps(asdict(cost)))
        return
    print(report(options.nodes, options.executor, options.tracker))
    print(f"\n{computer()}; {options.executor}, {options.tracker}")


if __name__ == "__main__":
    main()

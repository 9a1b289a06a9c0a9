"""What must be true of a store whose sweep has come to its end, whatever happened to it before."""

import filecmp
from collections import Counter
from pathlib import Path
from typing import Any

from components.core.files import read_json
from flows.pipeline.plan import Plan

__all__ = ["compared", "leftovers", "recorded"]

_TIMES = "node.json"  # holds when, where and how long; its digests of files are compared with them


def compared(plan: Plan, undisturbed: Path, soaked: Path) -> list[str]:
    """Differences between the artifacts and tables of two stores, a sentence each."""
    found = []
    for node in plan:
        one, other = (store / "nodes" / node.key for store in (undisturbed, soaked))
        names = [sorted(_files(folder)) for folder in (one, other)]
        if names[0] != names[1]:
            found.append(f"{node.name} has other files: {names[1]} instead of {names[0]}")
            continue
        differ = [n for n in names[0] if not filecmp.cmp(one / n, other / n, shallow=False)]
        if differ:
            found.append(f"{node.name} differs in {', '.join(differ)}")
    ours = {node.key for node in plan}
    if others := {path.name for path in (soaked / "nodes").iterdir()} - ours:
        found.append(f"artifacts of no node: {sorted(others)}")
    tables = [(store / "reports" / "soak" / "results.csv") for store in (undisturbed, soaked)]
    if not filecmp.cmp(*tables, shallow=False):
        found.append("the tables differ")
    return found


def _files(folder: Path) -> list[str]:
    return [
        str(path.relative_to(folder))
        for path in folder.rglob("*")
        if path.is_file() and path.name != _TIMES
    ]


def leftovers(store: Path, temporary: Path) -> list[str]:
    """What unfinished or killed processes have left, a sentence each."""
    places = [store / name for name in ("work", "locks", "progress", "damaged")]
    found = [
        f"left in {folder.name}/: {', '.join(left)}"
        for folder in places
        if (left := _entries(folder))
    ]
    if left := [name for name in _entries(temporary) if "ray" in name]:
        found.append(f"left of Ray: {', '.join(left)}")
    record = read_json(store / "drivers" / "soak.json") or {}
    if record.get("ended") != "FINISHED" or record.get("running"):
        found.append(f"the driver's last word is {record.get('ended')!r}")
    return found


def _entries(folder: Path) -> list[str]:
    kept = (".in-use",)  # the lock file of the whole store
    return sorted(p.name for p in folder.iterdir() if p.name not in kept) if folder.exists() else []


def recorded(plan: Plan, address: str) -> list[str]:
    """What is wrong with the record in MLflow: one finished run per node under one sweep."""
    from mlflow import MlflowClient

    client = MlflowClient(tracking_uri=address)
    runs: list[Any] = []
    page = None
    for experiment in client.search_experiments():
        while True:
            part = client.search_runs([experiment.experiment_id], page_token=page)
            runs += part
            page = part.token
            if not page:
                break
    done = Counter(
        run.data.tags.get("key", "")
        for run in runs
        if run.info.status == "FINISHED" and run.data.tags.get("role") == "node"
    )
    found = [f"{done[n.key]} finished runs of {n.name}" for n in plan if done[n.key] != 1]
    if strange := done.keys() - {node.key for node in plan}:
        found.append(f"finished runs of no node: {sorted(strange)}")
    sweeps = [run.info.status for run in runs if run.data.tags.get("role") == "sweep"]
    if sweeps != ["FINISHED"]:
        found.append(f"sweeps in MLflow: {sweeps}")
    if running := [run.info.run_name for run in runs if run.info.status == "RUNNING"]:
        found.append(f"still open in MLflow: {running}")
    return found

"""Computes a group of nodes in the present process, which an executor has chosen."""

import importlib.metadata
import os
import platform
import resource
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from components.core.files import write_json
from flows.pipeline.plan import Node
from flows.pipeline.store import ArtifactStore, Work, disk_error_message
from flows.pipeline.task import FAILURE_FILE, Job, StopRequested, TaskContext, load_task

__all__ = ["GroupCall", "GroupResult", "run_group"]


@dataclass(frozen=True)
class GroupCall:
    """Nodes to be computed in one task call; plain data, so that any computer can take it.

    Attributes:
        group: Name of the group, for its progress file.
        root: Absolute folder of the store.
        task: Import path of the task function.
        nodes: Per node its key, name, component, version, config, input keys and folders by
            role, tags, cost.
        device: "cpu" or "cuda".
        threads: Threads to use.
    """

    group: str
    root: str
    task: str
    nodes: tuple[Mapping[str, Any], ...]
    device: str = "cpu"
    threads: int = 1

    @classmethod
    def of(
        cls, group: str, root: Path, nodes: Sequence[Node], device: str = "cpu", threads: int = 1
    ) -> "GroupCall":
        """Describes nodes, all of one task, as plain data."""
        described = tuple(
            {
                "key": node.key,
                "name": node.name,
                "component": node.component,
                "version": node.version,
                "config": dict(node.config),
                "inputs": {role: source.key for role, source in node.inputs.items()},
                "folders": dict(node.folders),
                "tags": dict(node.tags),
                "cost": node.cost,
            }
            for node in nodes
        )
        return cls(group, str(root), nodes[0].task, described, device, threads)

    @property
    def title(self) -> str:
        """The group's first node and how many more, for messages."""
        first = self.nodes[0]["name"]
        return first if len(self.nodes) == 1 else f"{first} and {len(self.nodes) - 1} more"


@dataclass
class GroupResult:
    """How the nodes of a group ended.

    Attributes:
        group: Name of the group.
        finished: Keys that are now complete in the store.
        failed: Traceback or reason per key.
        stopped: Keys whose computation the driver has stopped.
    """

    group: str
    finished: list[str] = field(default_factory=list)
    failed: dict[str, str] = field(default_factory=dict)
    stopped: list[str] = field(default_factory=list)


def run_group(call: GroupCall, watch: Callable[[], None] = lambda: None) -> GroupResult:
    """Computes the nodes of a group that are not finished yet and publishes their artifacts.

    Exceptions of the task become failures in the result; only interrupts pass through.

    Args:
        call: The group.
        watch: Called at every validation, see :class:`flows.pipeline.task.TaskContext`.
    """
    os.environ["OMP_NUM_THREADS"] = str(call.threads)
    store = ArtifactStore(call.root, create=False)
    keys = [node["key"] for node in call.nodes]
    result = GroupResult(call.group)
    try:
        with store.locked(keys):
            # Another driver, or a worker of a killed one, may have finished some in the meantime.
            for work in store.work_folders():
                if store.unfinished(work) & set(keys):
                    store.publish_ready(work)
            pending = [node for node in call.nodes if not store.complete(node["key"])]
            if pending:
                _compute(store, call, pending, result, watch)
        unmade = {*result.failed, *result.stopped}
        result.finished = [key for key in keys if key not in unmade]
    except (KeyboardInterrupt, SystemExit):  # the latter by SIGTERM, which is no failure
        raise
    except BaseException as error:
        reason = _reason(error, store)
        result.failed.update({key: reason for key in keys if not store.path(key).is_dir()})
        result.finished = [key for key in keys if key not in result.failed]
    return result


def _compute(
    store: ArtifactStore,
    call: GroupCall,
    nodes: list[Mapping[str, Any]],
    result: GroupResult,
    watch: Callable[[], None],
) -> None:
    keys = [node["key"] for node in nodes]
    work = store.open_work(keys)
    store.fresh_out(work, keys)
    jobs = [_job(store, work, node) for node in nodes]
    context = TaskContext(
        work=work.path,
        members=list(work.members),
        device=call.device,
        threads=call.threads,
        progress_file=store.progress_file(call.group),
        stop_file=store.stop_file(call.group),
        watch=watch,
    )
    task = load_task(call.task)
    if "torch" in sys.modules:
        # A reused process keeps the thread count of its first task otherwise.
        sys.modules["torch"].set_num_threads(call.threads)
    context.begin()
    started, clock, used = time.time(), time.monotonic(), _cpu_seconds()
    try:
        task(jobs, context)
    except StopRequested:
        result.stopped = keys
        store.discard(work)
        return
    usage = {
        "started": started,
        "finished": time.time(),
        "wall_seconds": time.monotonic() - clock,  # the two times also change with the clock
        "cpu_seconds": _cpu_seconds() - used,
        "peak_rss_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "resumed": work.resumed,
        "device": call.device,
        "threads": call.threads,
    }
    whole = sum(node["cost"] for node in nodes)
    ready = []
    for job, node in zip(jobs, nodes, strict=True):
        failure = job.out / FAILURE_FILE
        if failure.exists():
            result.failed[job.key] = failure.read_text(encoding="utf-8")
        elif not any(job.out.iterdir()):
            result.failed[job.key] = f"The task {call.task} wrote nothing for {job.name}."
        else:
            _describe(job.out, node, usage, node["cost"] / whole)
            ready.append(job.key)
    store.mark_ready(work, ready)
    store.publish_ready(work)


def _job(store: ArtifactStore, work: Work, node: Mapping[str, Any]) -> Job:
    inputs = {role: store.path(key) for role, key in node["inputs"].items()}
    for role, folder in inputs.items():
        if not folder.is_dir():
            raise FileNotFoundError(
                f"The input {role!r} of {node['name']} is missing ({folder}): "
                "give the same command again, and it will be made."
            )
    inputs |= {role: Path(folder) for role, folder in node["folders"].items()}
    return Job(node["key"], node["name"], dict(node["config"]), inputs, work.out(node["key"]))


def _describe(out: Path, node: Mapping[str, Any], usage: Mapping[str, Any], share: float) -> None:
    wall = usage["wall_seconds"]
    described = {name: node[name] for name in ("key", "name", "component", "version", "config")}
    described |= {name: node[name] for name in ("inputs", "tags", "cost")}
    described |= dict(usage)
    described |= {"share": share, "seconds": wall * share}
    described |= {"hardware": hardware(usage["device"]), "package": _package_version()}
    write_json(out / "node.json", described)


def _reason(error: BaseException, store: ArtifactStore) -> str:
    text = "".join(traceback.format_exception(error)).rstrip()
    sentence = disk_error_message(error, store.root)
    if sentence is None and (
        isinstance(error, MemoryError) or "out of memory" in str(error).lower()
    ):
        sentence = (
            "Memory ran out: lower runner.cpus, so that fewer tasks run at once, or the batch."
        )
    return f"{text}\n{sentence}" if sentence else text


def _cpu_seconds() -> float:
    own = resource.getrusage(resource.RUSAGE_SELF)
    children = resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def _package_version() -> str:
    try:
        return importlib.metadata.version("proximity-bench")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


@cache
def hardware(device: str) -> str:
    """The computer's processors, memory and software in one line, without its name."""
    model = platform.processor() or platform.machine()
    try:
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                model = line.partition(":")[2].strip()
                break
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
        size = f", {memory:.0f} GiB"
    except (OSError, ValueError):
        size = ""
    line = f"{os.cpu_count()} x {model}{size}, Python {platform.python_version()}"
    if device == "cuda" and "torch" in sys.modules:
        line += f", {sys.modules['torch'].cuda.get_device_name()}"
    return line

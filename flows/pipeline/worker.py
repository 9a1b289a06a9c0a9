"""Computes a group of nodes in the present process, which an executor has chosen."""

import os
import resource
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from components.core.integrity import DamagedFileError, damaged_path, load_json
from components.core.sealed import content_digest, seal
from components.core.version import code_version
from flows.pipeline.computer import (
    cpu_seconds,
    hardware,
    release_memory,
    set_precision,
    software,
)
from flows.pipeline.costs import RULES
from flows.pipeline.failures import failure_reason, ran_out_of_memory
from flows.pipeline.group import GroupCall, GroupResult
from flows.pipeline.source import commit
from flows.pipeline.store import ArtifactStore, Work
from flows.pipeline.task import (
    FAILURE_FILE,
    Job,
    PauseRequested,
    StopRequested,
    TaskContext,
    load_task,
)

__all__ = ["run_group"]


def run_group(call: GroupCall, watch: Callable[[], None] = lambda: None) -> GroupResult:
    """Computes the nodes of a group that are not finished yet and publishes their artifacts.

    Exceptions of the task become failures in the result; only interrupts pass through.

    Args:
        call: The group.
        watch: Called at every report, see :class:`flows.pipeline.task.TaskContext`.
    """
    os.environ["OMP_NUM_THREADS"] = str(call.threads)
    store = _store_of(call)
    keys = [node["key"] for node in call.nodes]
    result = GroupResult(call.group)
    try:
        with store.locked(keys):
            store.fetch({*keys, *(key for node in call.nodes for key in node["inputs"].values())})
            # Another driver, or a worker of a killed one, may have finished some in the meantime.
            works = [work for work in store.work_folders() if store.unfinished(work) & set(keys)]
            for work in works:
                store.publish_ready(work)
            pending = [node for node in call.nodes if not _is_finished(store, call, node, result)]
            if pending and store.pause_file(call.group).exists():
                result.stopped = [node["key"] for node in pending]
            elif pending:
                _compute(store, call, pending, result, watch)
            for work in works:  # one begun for more nodes may have served its last
                if not store.unfinished(work):
                    store.discard(work)
    except (KeyboardInterrupt, SystemExit):  # the latter by SIGTERM, which is no failure
        raise
    except BaseException as error:
        left = [key for key in keys if not store.complete(key)]
        if ran_out_of_memory(error) and len(left) > 1:
            result.too_many = left
        else:
            result.failed.update(dict.fromkeys(left, failure_reason(error, store.root)))
    if result.too_many:
        release_memory()  # now that the error, which held what the task had made, is gone
    unmade = {*result.failed, *result.stopped, *result.too_many}
    result.finished = [key for key in keys if key not in unmade and store.complete(key)]
    return result


def _store_of(call: GroupCall) -> ArtifactStore:
    if not call.url:
        return ArtifactStore(call.root, create=False)
    from flows.pipeline.remote.shared_store import SharedStore  # most workers do without fsspec

    store = SharedStore(call.url, call.owner, repairs=call.repairs)
    store.forget_requests(call.group)
    return store


def _is_finished(
    store: ArtifactStore, call: GroupCall, node: Mapping[str, Any], result: GroupResult
) -> bool:
    """Whether a node is finished; something damaged in its place is set aside."""
    key = node["key"]
    place = store.place(key)
    if key in store.refused:
        raise DamagedFileError(store.refused[key], store.path(key))
    try:
        return place is not None and bool(store.check(key, large=False))
    except DamagedFileError as error:
        if not call.repairs:
            raise
        store.set_aside(key, place)
        result.notes.append(f"{error.sentence}: {node['name']} is made again.")
        return False


def _compute(
    store: ArtifactStore,
    call: GroupCall,
    nodes: list[Mapping[str, Any]],
    result: GroupResult,
    watch: Callable[[], None],
) -> None:
    """Makes the nodes; damage decides by the place of the file what happens.

    An input that is damaged is reported, for the driver to have it made again. Work that cannot be
    continued is thrown away, once, and begun anew.
    """
    content: dict[str, str | None] = {}
    for key in sorted({key for node in nodes for key in node["inputs"].values()}):
        try:
            content[key] = content_digest(store.check(key))
        except DamagedFileError as error:
            result.damaged[key] = store.refused.get(key, error.sentence)
    if result.damaged:
        return
    keys = [node["key"] for node in nodes]
    store.begin(keys)
    work = store.open_work(keys)
    try:
        _make(store, call, nodes, work, content, result, watch)
    except Exception as error:
        path = damaged_path(error)
        if path is None:
            raise
        kind = "a folder" if isinstance(error, IsADirectoryError) else "missing"
        sentence = error.sentence if isinstance(error, DamagedFileError) else f"{path} is {kind}"
        source = store.key_of(path)
        if source in content:
            result.damaged[source] = sentence
            return
        ours = path.is_relative_to(work.path) and work.resumed
        if not ours or not call.repairs:
            raise
        result.notes.append(f"{sentence}: {call.title} begins anew.")
        work = store.begin_anew(work, keys)
        _make(store, call, nodes, work, content, result, watch)


def _make(
    store: ArtifactStore,
    call: GroupCall,
    nodes: list[Mapping[str, Any]],
    work: Work,
    content: Mapping[str, str | None],
    result: GroupResult,
    watch: Callable[[], None],
) -> None:
    """Runs the task in a work folder and publishes what it made."""
    keys = [node["key"] for node in nodes]
    store.fresh_out(work, keys)
    jobs = [_job(store, work, node) for node in nodes]
    context = TaskContext(
        work=work.path,
        members=list(work.members),
        device=call.device,
        threads=call.threads,
        progress_file=store.progress_file(call.group),
        stop_file=store.stop_file(call.group),
        pause_file=store.pause_file(call.group),
        watch=watch,
    )
    task = load_task(call.task)
    if "torch" in sys.modules:
        # A reused process keeps the thread count of its first task otherwise.
        sys.modules["torch"].set_num_threads(call.threads)
    set_precision(call.device, call.precision)
    context.begin()
    started, clock, used = time.time(), time.monotonic(), cpu_seconds()
    try:
        with store.carrying(call.group, work):
            task(jobs, context)
    except PauseRequested:
        result.stopped = keys
        return
    except StopRequested:
        result.stopped = keys
        store.discard(work)
        return
    usage = {
        "started": started,
        "finished": time.time(),
        "wall_seconds": time.monotonic() - clock,  # the two times also change with the clock
        "cpu_seconds": cpu_seconds() - used,
        "peak_rss_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "resumed": work.resumed,
        "device": call.device,
        "threads": call.threads,
        "steady_seconds": context.steady_seconds,
        "lanes": len(nodes),
        "cost_rules": RULES,
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
            read = {role: content[key] for role, key in node["inputs"].items()}
            _describe(job.out, node, read, usage, node["cost"] / whole)
            ready.append(job.key)
    store.mark_ready(work, ready)
    store.publish_ready(work, check=False)


def _job(store: ArtifactStore, work: Work, node: Mapping[str, Any]) -> Job:
    inputs = {role: store.path(key) for role, key in node["inputs"].items()}
    inputs |= {role: store.folder(named) for role, named in node["folders"].items()}
    return Job(node["key"], node["name"], dict(node["config"]), inputs, work.out(node["key"]))


def _describe(
    out: Path,
    node: Mapping[str, Any],
    content: Mapping[str, str | None],
    usage: Mapping[str, Any],
    share: float,
) -> None:
    """Write the record of an artifact; `content` digests what was read, by role."""
    wall = usage["wall_seconds"]
    described = {name: node[name] for name in ("key", "name", "component", "version", "config")}
    described |= {name: node[name] for name in ("inputs", "cost", "code")}
    further = load_json(out / "tags.json") if (out / "tags.json").exists() else {}
    described |= {"tags": {**further, **node["tags"]}}
    described |= {"content": dict(content)} | dict(usage)
    described |= {"share": share, "seconds": wall * share}
    described |= {"hardware": hardware(usage["device"]), "package": code_version()}
    described |= {"commit": commit()}
    described |= {"software": software(usage["device"])}
    seal(out, described)

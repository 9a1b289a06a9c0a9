"""An executor on Ray: on this computer, or on the cluster that RAY_ADDRESS names.

Ray is only asked to start a function in another process and to say when it ended. Whether a group
is started again after its worker died is decided here, so that it can be counted, shown and
limited: Ray's own retries are silent, and those after lack of memory never end.
"""

import contextlib
import logging
import os
import secrets
import socket
from collections.abc import Callable
from typing import Any

from flows.pipeline.errors import PipelineError
from flows.pipeline.worker import GroupCall, GroupResult, run_group

__all__ = ["RayExecutor", "available_cpus"]

_OBJECT_STORE_BYTES = 200 * 2**20  # results are a few keys; artifacts go through the disk


def available_cpus() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class RayExecutor:
    """Runs groups as Ray tasks: on this computer, or on the cluster that RAY_ADDRESS names."""

    def __init__(
        self,
        *,
        cpus: int | None = None,
        threads: int = 1,
        device: str = "cpu",
        gpus: int = 1,
        gpus_per_task: float = 0.5,
        retries: int = 3,
    ) -> None:
        """Describes the cluster; nothing starts before `start`.

        Args:
            cpus: Processors to use on this computer; all by default. A cluster knows its own.
            threads: Threads, and therefore processors, of one group.
            device: "cpu" or "cuda".
            gpus: GPUs of this computer, if the device is "cuda". A cluster knows its own.
            gpus_per_task: Share of a GPU that one group occupies if the device is "cuda".
            retries: How often a group is started again after its worker died.
        """
        self.threads = threads
        self.device = device
        self._cpus = cpus or available_cpus()
        self._gpus = gpus_per_task if device == "cuda" else 0.0
        self.slots = max(1, _places(self._cpus, threads, gpus, self._gpus))
        self._retries = retries
        self._running: dict[Any, tuple[GroupCall, int]] = {}
        self._notify: Callable[[str], None] = lambda text: None

    def start(
        self, notify: Callable[[str], None], watch: Callable[[], None] = lambda: None
    ) -> None:
        """Starts Ray on this computer or connects to the cluster.

        Nothing calls `watch`: the work goes on in other processes while `wait` returns.

        Raises:
            PipelineError: Ray cannot be started or reached, or has too few processors.
        """
        self._notify = notify
        address = os.environ.get("RAY_ADDRESS")
        _set_ray_environment(local=not address)
        _check_address(address)
        import ray  # reads its environment at import, and costs a second

        self._ray = ray
        local: dict[str, Any] = {"num_cpus": self._cpus, "object_store_memory": _OBJECT_STORE_BYTES}
        try:
            ray.init(
                address=address or "local",
                include_dashboard=None if address else False,
                log_to_driver=False,
                logging_level=logging.ERROR,
                **({} if address else local),
            )
        except Exception as error:
            where = f"the cluster at RAY_ADDRESS={address}" if address else "Ray on this computer"
            raise PipelineError(
                f"Could not reach {where} ({_first_line(error)}): "
                "start it, unset RAY_ADDRESS, or set runner.executor=serial."
            ) from error
        _silence(ray)
        if address:
            resources = ray.cluster_resources()
            cpus, gpus = (int(resources.get(name, 0)) for name in ("CPU", "GPU"))
            self.slots = _places(cpus, self.threads, gpus, self._gpus)
        if self.slots < 1 or (self._gpus and not ray.cluster_resources().get("GPU")):
            raise PipelineError(
                f"Ray offers no place for a task with {self.threads} processors on "
                f"{self.device!r}: lower runner.threads or change runner.device."
            )
        self._remote = ray.remote(num_cpus=self.threads, num_gpus=self._gpus, max_retries=0)(
            run_group
        )

    def submit(self, call: GroupCall) -> None:
        """Hands a group to Ray."""
        self._running[self._remote.options(name=call.title).remote(call)] = (call, 0)

    def wait(self, timeout: float) -> list[GroupResult]:
        """Groups that ended; those whose worker died are started again instead."""
        if not self._running:
            return []
        try:
            ready, _ = self._ray.wait(list(self._running), num_returns=1, timeout=timeout)
            if ready:
                everything = list(self._running)
                ready, _ = self._ray.wait(everything, num_returns=len(everything), timeout=0)
        except self._ray.exceptions.RayError as error:
            raise PipelineError(
                f"Ray is gone ({_first_line(error)}): give the same command again to continue."
            ) from error
        results = []
        for reference in ready:
            call, deaths = self._running.pop(reference)
            result = self._take(reference, call, deaths)
            if result is not None:
                results.append(result)
        return results

    def _take(self, reference: Any, call: GroupCall, deaths: int) -> GroupResult | None:
        exceptions = self._ray.exceptions
        try:
            result: GroupResult = self._ray.get(reference)
            return result
        except exceptions.RayTaskError as error:
            # Raised outside `run_group`: for example, the worker cannot import this package.
            return _lost(call, str(error))
        except exceptions.TaskCancelledError:
            raise KeyboardInterrupt from None
        except exceptions.RayError as error:
            memory = isinstance(error, exceptions.OutOfMemoryError)
            why = "ran out of memory" if memory else "died"
            if deaths < (1 if memory else self._retries):
                self._notify(
                    f"The worker of {call.title} {why}; starting again from the checkpoint."
                )
                self._running[self._remote.options(name=call.title).remote(call)] = (
                    call,
                    deaths + 1,
                )
                return None
            remedy = (
                "lower runner.cpus, so that fewer tasks run at once, or the batch"
                if memory
                else "see why (killed, or a crash in native code?) and give the same command again"
            )
            return _lost(
                call,
                f"{_first_line(error)}\n"
                f"The worker of {call.title} {why} {deaths + 1} times: {remedy}.",
            )

    def stop(self) -> None:
        """Interrupts running tasks and leaves Ray."""
        ray = getattr(self, "_ray", None)
        if ray is None:
            return
        for reference in self._running:
            with contextlib.suppress(Exception):
                ray.cancel(reference)
        if self._running:
            with contextlib.suppress(Exception):
                ray.wait(list(self._running), num_returns=len(self._running), timeout=2)
        self._running.clear()
        ray.shutdown()


def _places(cpus: int, threads: int, gpus: int, share: float) -> int:
    """Groups that run at once, each on ``threads`` processors and a ``share`` of one GPU, if any.

    A share does not reach across GPUs: two of them at 0.4 hold four groups.
    """
    places = cpus // threads
    return min(places, gpus * int(1 / share)) if share else places


def _lost(call: GroupCall, reason: str) -> GroupResult:
    return GroupResult(call.group, failed={node["key"]: reason for node in call.nodes})


def _first_line(error: BaseException) -> str:
    return next(iter(str(error).strip().splitlines()), type(error).__name__).rstrip(".")


def _check_address(address: str | None) -> None:
    """Finds a wrong address in seconds, where Ray itself would try for minutes.

    Raises:
        PipelineError: nothing listens there.
    """
    host, colon, port = (address or "").rpartition("://")[2].rpartition(":")
    if not colon or not port.isdigit():
        return  # none, "auto" or a form that only Ray knows
    try:
        socket.create_connection((host.strip("[]"), int(port)), timeout=10).close()
    except OSError as error:
        raise PipelineError(
            f"Nothing answers at RAY_ADDRESS={address} ({error.strerror or error}): "
            "start the cluster, correct the address, or unset it to use this computer."
        ) from error


def _set_ray_environment(*, local: bool) -> None:
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_task_oom_retries", "1")
    # A fresh secret per run: works with a home folder that cannot be written, and prints nothing.
    if local and "RAY_AUTH_MODE" not in os.environ and "RAY_AUTH_TOKEN" not in os.environ:
        os.environ["RAY_AUTH_MODE"] = "token"
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(16)


def _silence(ray: Any) -> None:
    # Deaths of workers are announced in a block of text on stdout that no option turns off; we
    # report them ourselves. Should Ray rename the function, the text comes back, nothing else.
    module = ray._private.worker
    if hasattr(module, "print_to_stdstream"):
        module.print_to_stdstream = lambda *args, **kwargs: None
